"""Tables of a comparison whose every number is known, and what is written of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.long_term.protocols import FEATURES
from infgen.views.published import ABLATIONS, PAPER
from infgen.views.sheets import Measured
from pipeline.comparison.execution import ExecutedRun
from pipeline.comparison.figures import charts, curve_sheet
from pipeline.comparison.result import ComparisonResult
from pipeline.comparison.runs import ArmRun
from pipeline.comparison.tables import caveats, standing_alone, tables
from pipeline.stages.score.summary import Tally
from tests.pipeline.compared import arm, compared, scored

INFGEN = arm("infgen", label="InfGen", published="InfGen")
SMART = arm("smart", label="SMART", published="SMART-7M")
CATK = arm("catk", label="CatK", published="CatK")
NO_CELL = arm("no-cell", label="no cell token", published="no cell token", ablates="infgen")
SCORES = [f"{p}/{f.name}" for p in ("paper", "corrected") for f in FEATURES]
WAVES = {
    **{name: [0.5, 0.5] for name in SCORES},
    "corrected/entry_rate": [0.5, 1.0],
    "ace/truth_near": [2.0, 4.0],
}


def long_numbers(ace, entries, composite):
    return {
        "ace/truth_near": ace,
        "ace_slope/truth_near": (ace / 10, ace / 20, ace / 5),
        "paper/composite": composite,
        "paper/placement": composite / 2,
        "corrected/composite": composite,
        "corrected/entry_rate": entries,
        "corrected/exit_rate": 2 * entries,
        "agents/near": 20.0,
        "corrected/inserted_offroad_rate": 0.25,
    }


def run(method, ace, score, *, seed=0, entries=1.0):
    means = {
        "one": {
            "ace/truth_near": ace,
            "ace_slope/truth_near": ace / 10,
            **dict.fromkeys(SCORES, score),
        }
    }
    numbers = long_numbers(ace, entries, score)
    return scored(method, seed, means, numbers=numbers, curves=WAVES)


@pytest.fixture
def found() -> ComparisonResult:
    """Three methods and an ablation, played long; two of them for eight seconds too."""
    wosac = [
        scored(
            method,
            0,
            {"one": {"wosac/metametric": mean}},
            mode="wosac",
            numbers={"wosac/metametric": (mean, *ends)},
        )
        for method, mean, *ends in ((INFGEN, 0.6), (SMART, 0.75, 0.7, 0.8))
    ]
    logs = Tally({"one": {"corrected/entry_rate": 0.8, "agents/near": 21.0}}, 1)
    runs = [
        run(INFGEN, 2.0, 0.6, entries=1.0),
        run(SMART, 4.0, 0.5),
        run(CATK, 5.0, 0.4),
        run(NO_CELL, 3.0, 0.3),
    ]
    lost = ExecutedRun(
        ArmRun("mini", CATK, 0, "wosac"), "failed", "rollout: x: ValueError: y"
    )
    return compared([*runs, *wosac], logs, missing=[lost])


@pytest.fixture
def sheets(found):
    return {sheet.name: sheet for sheet in tables(found)}


def cell(sheet, row, column):
    names = [line[0] for line in sheet.rows]
    return sheet.rows[names.index(row)][list(sheet.columns).index(column)]


def test_there_is_a_table_for_all_that_was_played(sheets):
    assert list(sheets) == [
        "claims",
        "table-1-short-term",
        "table-2-long-term",
        "table-5-ablations",
        "against-the-logs",
        "runs",
    ]


def test_a_claim_is_our_method_as_a_multiple_of_another_beside_the_papers(sheets):
    claims = sheets["claims"]

    published = "InfGen / SMART, published"
    assert claims.columns[:3] == ["number", "InfGen / SMART", published]
    ours = cell(claims, "Mean ACE", "InfGen / SMART")
    assert ours.mean == pytest.approx(2 / 4)
    assert cell(claims, "Mean ACE", "InfGen / CatK").mean == pytest.approx(2 / 5)
    assert claims.rows[0][2] == pytest.approx(8.1 / 12.0)
    assert claims.rows[1][4] == pytest.approx(0.15 / 0.32)
    row = cell(claims, "composite (paper)", "InfGen / SMART")
    assert row.mean == pytest.approx(0.6 / 0.5)
    assert cell(claims, "composite (paper)", published) == pytest.approx(0.6606 / 0.6519)
    assert cell(claims, "composite (corrected)", published) is None
    eight = cell(claims, "eight seconds: composite", "InfGen / SMART")
    assert eight.mean == pytest.approx(0.6 / 0.75)
    assert cell(claims, "eight seconds: composite", published) == pytest.approx(
        0.7514 / 0.7521
    )


def test_methods_stand_beside_the_published_rows_in_table_2(sheets):
    table = sheets["table-2-long-term"]
    names = [row[0] for row in table.rows]

    assert names[:3] == [f"{each.method}, published" for each in PAPER]
    assert names[3:7] == [
        "InfGen, ours (paper)",
        "SMART, ours (paper)",
        "CatK, ours (paper)",
        "the logs (paper)",
    ]
    assert cell(table, "SMART-7M, published", "Mean ACE") == 12.0
    assert cell(table, "SMART, ours (paper)", "Mean ACE") == Measured(4.0)
    slope = cell(table, "SMART, ours (paper)", "ACE slope")
    assert (slope.low, slope.mean, slope.high) == (0.2, 0.4, 0.8)
    assert "the same moment of the scene's own log" in table.note
    assert "no cell token" not in str(names)


def test_table_1_has_those_that_were_played_for_eight_seconds(sheets):
    table = sheets["table-1-short-term"]

    ours = [row for row in table.rows if row[0].endswith("ours")]
    assert [row[0] for row in ours] == ["InfGen, ours", "SMART, ours"]
    assert ours[1][1] == Measured(0.75, 0.7, 0.8)
    assert "wosac-2025: 1 of 1" in table.note


def test_ablations_stand_below_what_they_leave_something_out_of(sheets):
    table = sheets["table-5-ablations"]
    names = [row[0] for row in table.rows]

    assert names[:2] == ["InfGen, published", "no cell token, published"]
    assert cell(table, "no cell token, published", "placement") == 0.4378
    assert cell(table, "InfGen, published", "composite") == ABLATIONS["InfGen"]["composite"]
    assert names[2:4] == ["InfGen, ours (paper)", "no cell token, ours (paper)"]


def test_entries_are_counted_per_half_second_and_held_against_the_logs(sheets):
    table = sheets["against-the-logs"]

    assert cell(table, "the logs of these scenes", "entries per half second") == 0.4
    assert cell(table, "InfGen", "entries per half second") == Measured(0.5)
    assert cell(table, "InfGen", "entries, % off") == pytest.approx(25.0)
    assert cell(table, "InfGen", "inserted agents' off-road rate") == Measured(0.25)
    assert cell(table, "the logs of these scenes", "agents near the ego") == 21.0
    assert table.rows[0][3] is None  # No log says how many left.


def test_every_run_is_listed_with_its_weights_and_what_is_missing_is_named(sheets, found):
    table = sheets["runs"]

    assert len(table.rows) == 7
    assert cell(table, "infgen, seed 0, long", "weights") == "weights of infge"
    assert cell(table, "catk, seed 0, wosac", "missing") == "rollout: x: ValueError: y"
    assert found.missing == ["catk, seed 0, wosac: rollout: x: ValueError: y"]


def test_seeds_are_averaged_and_the_note_says_what_the_interval_is(found):
    runs = [run(INFGEN, 2.0, 0.6), run(INFGEN, 4.0, 0.6, seed=1)]

    several = compared(runs)

    (table,) = [sheet for sheet in tables(several) if sheet.name == "table-2-long-term"]
    ace = cell(table, "InfGen, ours (paper)", "Mean ACE")
    assert ace.mean == 3.0
    assert ace.high - ace.mean == pytest.approx(12.706 * 1.0)  # sqrt(2) / sqrt(2)
    alone = standing_alone(several, table)
    assert "2 seeds" in alone.note
    assert "Student's t" in alone.note
    assert "the same moment" in alone.note
    assert "compare directions, not digits" in alone.note
    assert "One seed" in " ".join(caveats(found))


def test_curves_of_all_arms_are_in_one_chart_of_each_number(found):
    drawn = charts(found)

    assert [part for part in drawn if part.title == "Agent count error (ACE) by window"]
    (entries,) = [part for part in drawn if part.title == "Entries within 75 m by window"]
    for label in ("InfGen", "SMART", "CatK", "no cell token"):
        assert f">{label}</text>" in entries.to_svg()
    sheet = curve_sheet(found)
    row = ["InfGen", "corrected/entry_rate", 4.5, 1.0]
    assert row in sheet.rows
    assert ["SMART", "ace/truth_near", 4.0, 2.0] in sheet.rows


def test_a_comparison_of_nothing_is_a_list_of_what_failed():
    lost = ExecutedRun(
        ArmRun("mini", INFGEN, 0, "long"), "failed", "train: weights: OSError: full"
    )

    empty = compared([], missing=[lost])

    (only,) = tables(empty)
    assert only.name == "runs"
    assert charts(empty) == []
    assert empty.to_json()["missing"] == [
        "infgen, seed 0, long: train: weights: OSError: full"
    ]


def test_a_comparison_is_json_without_any_nan(found):
    text = json.dumps(found.to_json(), allow_nan=False)

    told = json.loads(text)
    assert told["arms"]["smart"]["long"]["ace/truth_near"]["mean"] == 4.0
    assert told["runs"][0]["weights"] == "weights of infgen 0"
    assert not np.isnan(told["runs"][0]["scenes"])


def test_rollout_sets_of_several_splits_have_tables_of_their_own(found):
    whole = replace(found, parts={"validation.argoverse2": found, "*_20s": found})

    sheets = {sheet.name: sheet.title for sheet in tables(whole)}
    single = len(tables(found)) - 1
    assert len(sheets) == 2 * single + 1  # Runs are listed once.
    assert sheets["claims-validation.argoverse2"].endswith("(validation.argoverse2)")
    assert sheets["claims-_20s"].endswith("(*_20s)")
    assert len(charts(whole)) == 2 * len(charts(found))
    assert "InfGen, *_20s" in [row[0] for row in curve_sheet(whole).rows]
