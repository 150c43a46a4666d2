import csv
import io
import re

import pytest

from infgen.views.published import PAPER
from infgen.views.tables import Table, flatten, markdown, words

TABLE = Table(
    title="A & B",
    columns=["name", "value", "count"],
    rows=[["x|y", 0.123456789, 3], ["<b>", None, -1]],
    note="50 % of $5_000",
)


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        (None, "-"),
        (0.12345, "0.1235"),
        (-2.0, "-2.0000"),
        (12.345, "12.35"),
        (3, "3"),
        ("a", "a"),
    ],
)
def test_cells_are_written_for_people(cell, expected):
    assert words(cell) == expected


def test_markdown_keeps_its_columns_whatever_the_cells_hold():
    lines = TABLE.to_markdown().splitlines()

    assert lines[0] == "### A &amp; B"
    rows = [line for line in lines if line.startswith("|")]
    assert rows[1] == "| --- | ---: | ---: |"
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 4 for row in rows)
    assert rows[3] == "| &lt;b&gt; | - | -1 |"


def test_markdown_cannot_be_broken_out_of():
    assert markdown("a\nb `c` [d](e) *f* <g>") == r"a b \`c\` \[d\](e) \*f\* &lt;g&gt;"


def test_latex_knows_plus_and_minus():
    assert r"0.5 $\pm$ 0.1" in Table("t", ["a"], [["0.5 ± 0.1"]]).to_latex()


def test_latex_escapes_what_latex_reads():
    latex = TABLE.to_latex()

    assert r"\caption{A \& B. 50 \% of \$5\_000}" in latex
    assert r"x|y & 0.1235 & 3 \\" in latex
    backslash = Table("t", ["a\\b{c}~^#"], []).to_latex()
    assert r"a\textbackslash{}b\{c\}\textasciitilde{}\textasciicircum{}\#" in backslash


def test_csv_reads_back_as_it_was():
    rows = list(csv.reader(io.StringIO(TABLE.to_csv())))

    assert rows == [["name", "value", "count"], ["x|y", "0.123457", "3"], ["<b>", "", "-1"]]


@pytest.mark.parametrize("cell", ["=1+1", "+1", "-1", "@a"])
def test_no_spreadsheet_takes_a_word_for_a_formula(cell):
    (row,) = list(csv.reader(io.StringIO(Table("t", ["a"], [[cell]]).to_csv())))[1:]

    assert row == [f"'{cell}"]


def test_json_keeps_numbers_as_numbers():
    assert TABLE.to_json() == {
        "columns": ["name", "value", "count"],
        "rows": [["x|y", 0.123457, 3], ["<b>", None, -1]],
    }


def test_nested_figures_are_listed_by_dotted_names():
    found = flatten({"a": {"b": 1, "c": [0.5, None]}, "d": "e"})

    assert found == [("a.b", 1), ("a.c", "0.5000, -"), ("d", "e")]


def test_published_rows_are_those_of_the_paper():
    infgen, smart, catk = PAPER

    assert [each.method for each in PAPER] == ["InfGen", "SMART-7M", "CatK"]
    assert infgen.long_term["placement"] == 0.4542
    assert smart.motion_only["composite"] == 0.7428
    assert catk.short_term["map"] == 0.8732
    assert (infgen.mean_ace, infgen.ace_slope) == (8.1, 0.15)
    for each in PAPER:
        events = ("num_entries", "num_exits", "entry_distance", "exit_distance")
        mean = sum(each.long_term[name] for name in events) / 4
        assert mean == pytest.approx(each.long_term["placement"], abs=6e-5)


def test_links_stay_out_of_what_is_no_page():
    table = Table("t", ["a", "b"], [["<x>", 1], ["y", 2]], links=["p&q.html", ""])

    assert "p&q" not in table.to_markdown() + table.to_csv() + table.to_latex()


def test_a_table_is_named_after_its_title():
    assert Table("Beside the paper: 30 s (Table 2)", [], []).name == (
        "beside-the-paper-30-s-table-2"
    )
