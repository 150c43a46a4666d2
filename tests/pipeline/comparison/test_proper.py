from dataclasses import replace

import pytest

from infgen.config import ScoreSettings
from infgen.views.sheets import Measured
from pipeline.comparison.proper import motion_only_arm, proper
from tests.pipeline.compared import arm, compared, scored

INFGEN = arm("infgen", label="InfGen")
SMART = arm("smart", label="SMART")
NAMES = {
    "proper/energy": 1.5,
    "proper/skill_persistence/energy": (0.4, 0.3, 0.5),
    "proper/spread_skill/vehicles": 0.9,
}
RADIUS = ScoreSettings(bootstrap_resamples=200, presence_radius_m=75.0)


def run(method, energies, **more):
    means = {f"scene {at}": {"proper/energy": value} for at, value in enumerate(energies)}
    return scored(method, 0, means, numbers=NAMES, **more)


def cell(table, row, column):
    (found,) = [each for each in table.rows if each[0] == row]
    return found[table.columns.index(column)]


def test_skill_over_motion_only_is_that_of_the_same_scenes():
    smart = replace(run(SMART, [4.0, 8.0]), settings=RADIUS)

    table = proper(compared([run(INFGEN, [1.0, 2.0]), smart]))

    skill = cell(table, "InfGen", "skill over motion only")
    assert (skill.mean, skill.low, skill.high) == pytest.approx((0.75, 0.75, 0.75))
    assert cell(table, "SMART", "skill over motion only") is None
    assert "radius heuristic (SMART)" in table.note


def test_the_ends_of_a_skill_are_in_their_order():
    smart = replace(run(SMART, [4.0, 8.0, 6.0]), settings=RADIUS)

    table = proper(compared([run(INFGEN, [1.0, 7.0, 2.0]), smart]))

    skill = cell(table, "InfGen", "skill over motion only")
    assert skill.low < skill.mean < skill.high


def test_numbers_stand_with_their_intervals():
    table = proper(compared([run(INFGEN, [1.0])]))

    assert cell(table, "InfGen", "energy score") == Measured(1.5)
    assert cell(table, "InfGen", "skill over as many as now") == Measured(0.4, 0.3, 0.5)
    assert cell(table, "InfGen", "skill over the split's distribution") is None


def test_without_the_radius_heuristic_skill_over_motion_only_is_not_measured():
    found = compared([run(INFGEN, [1.0]), run(SMART, [2.0])])

    assert motion_only_arm(found) is None
    assert cell(proper(found), "InfGen", "skill over motion only") is None
    assert "not measured" in proper(found).note


def test_runs_that_were_not_scored_by_it_have_no_table():
    old = scored(INFGEN, 0, {"scene": {}}, numbers={"agents/near": 20.0})

    assert proper(compared([old])).rows == []
