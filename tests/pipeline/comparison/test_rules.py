"""The table of what rules change, and what the others say of rules."""

import pytest

from infgen.views.sheets import Measured
from pipeline.comparison.rules import rules, rules_in_tables
from pipeline.comparison.tables import caveats, tables
from pipeline.stages.score.summary import Tally
from tests.pipeline.compared import arm, compared, scored

INFGEN = arm("infgen", label="InfGen", published="InfGen")
SMART = arm("smart", label="SMART", published="SMART-7M")
SAFE = arm("infgen-safe", label="InfGen", rules_of="infgen")
LOGS = Tally({"one": {"corrected/entry_rate": 0.8, "corrected/collision_rate": 0.04}}, 1)


def run(method, collisions, entries, **more):
    numbers = {
        "corrected/collision_rate": collisions,
        "corrected/entry_rate": (entries, entries - 0.2, entries + 0.2),
        "ace/truth_near": 2.0,
    }
    return scored(method, 0, {"one": {}}, numbers=numbers, **more)


@pytest.fixture
def found():
    return compared(
        [
            run(INFGEN, 0.2, 1.0),
            run(SMART, 0.3, 1.0),
            run(SAFE, 0.05, 1.4, rules="safe"),
            scored(INFGEN, 0, {"one": {}}, mode="wosac", numbers={"wosac/metametric": 0.6}),
        ],
        LOGS,
    )


def test_rules_on_stand_below_rules_off_and_both_below_the_logs(found):
    table = rules(found)
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]

    assert [(row["method"], row["rules"]) for row in rows] == [
        ("the logs of these scenes", None),
        ("InfGen", "none"),
        ("InfGen", "safe"),
    ]
    rates = [row["collision rate"] for row in rows]
    assert rates == [0.04, Measured(0.2), Measured(0.05)]
    entries = [row["entries per half second"] for row in rows]
    assert entries[0] == pytest.approx(0.4)
    ends = entries[2]
    assert (ends.low, ends.mean, ends.high) == pytest.approx((0.6, 0.7, 0.8))
    assert [row["Mean ACE"] for row in rows] == [None, Measured(2.0), Measured(2.0)]
    composites = [row["eight seconds: composite"] for row in rows]
    assert composites == [None, Measured(0.6), None]


def test_no_other_table_has_rollouts_with_rules(found):
    others = [sheet for sheet in tables(found) if sheet.name not in ("rules", "runs")]

    assert others
    assert found.arms == [INFGEN, SMART]
    for sheet in others:
        assert not any(cell == Measured(0.05) for row in sheet.rows for cell in row)
    names = [row[0] for sheet in others for row in sheet.rows]
    assert names.count("InfGen") == 1


def test_without_such_an_arm_there_is_no_table():
    names = [sheet.name for sheet in tables(compared([run(INFGEN, 0.2, 1.0)]))]

    assert "rules" not in names


def test_tables_say_that_there_are_no_rules(found):
    (said,) = rules_in_tables(found)

    assert "no rules (rollout.rules=none), no biases" in said
    assert said in caveats(found)


def test_tables_say_which_rollouts_have_rules_or_biases():
    ruled = run(INFGEN, 0.2, 1.0, rules="safe, max_stall_s=0", biased=True)

    (said,) = rules_in_tables(compared([ruled, run(SMART, 0.3, 1.0)]))

    assert "InfGen: safe, max_stall_s=0. Biases on insertions and removals: InfGen." in said
    assert "SMART" not in said
    assert rules_in_tables(compared([])) == []


def test_every_run_is_listed_with_its_rules(found):
    table = next(sheet for sheet in tables(found) if sheet.name == "runs")
    at = list(table.columns).index("rules")

    assert [row[at] for row in table.rows] == ["none", "none", "safe", "none"]
