import re
import xml.etree.ElementTree as ET

import jinja2
import pytest

from infgen.views.charts.canvas import Chart
from infgen.views.page import render
from infgen.views.tables import Table

TABLE = Table(
    title="A & B",
    columns=["name", "value", "count"],
    rows=[["x|y", 0.123456789, 3], ["<b>", None, -1]],
    note="50 % of $5_000",
)


def tables(*shown, title="t"):
    return render("tables.html", title=title, tables=shown)


def parsed(page):
    """A page is well-formed XML too, but for its doctype and its style."""
    body = re.search(r"<body>.*</body>", page, re.S)[0]
    return ET.fromstring(body)


def test_a_page_is_well_formed_and_everything_in_it_is_escaped():
    page = tables(TABLE, title="<Both> & more")
    root = parsed(page)

    assert [cell.text for cell in root.iter("td")] == [
        "x|y",
        "0.1235",
        "3",
        "<b>",
        "-",
        "-1",
    ]
    assert root.find(".//h3").text == "A & B"
    assert root.find("h1").text == "<Both> & more"
    assert root.find("p").text == "50 % of $5_000"
    assert "<b>" not in page
    assert "<Both>" not in page


def test_words_stand_to_the_left_and_figures_to_the_right_in_one_line():
    page = tables(Table("t", ["a", "b"], [["0.5 m", "0.5 ± 0.1"]]))

    assert '<td class="text">0.5 m</td>' in page
    assert "<td>0.5\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.1</td>" in page


def test_the_first_cell_of_a_row_leads_to_its_page():
    rows = [["one <1>", 1], ["two", 2]]
    page = tables(Table("t", ["a", "b"], rows, links=['p"age.html', ""]))

    (link,) = parsed(page).iter("a")
    assert (link.get("href"), link.text) == ('p"age.html', "one <1>")


def test_a_page_holds_its_charts_and_loads_nothing():
    chart = Chart("<c>", lambda axes: axes.plot([0, 1]), 200.0, 100.0, (9.0, 9.0, 9.0, 9.0))
    page = render("training.html", title="t", charts=[chart])

    assert chart.to_svg() in page
    assert page.startswith("<!doctype html>")
    assert not re.search(r"<script|<link|<img|@import|url\((?!#)", page)
    assert "prefers-color-scheme: dark" in page


def test_a_value_that_a_template_lacks_is_an_error():
    with pytest.raises(jinja2.UndefinedError, match="tables"):
        render("tables.html", title="t")
