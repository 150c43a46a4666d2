"""Learning curves of scores made by hand."""

from pipeline.comparison.learning_curve import (
    learning_curve,
    learning_curve_charts,
    learning_curve_scores,
    points,
)
from pipeline.settings.presets import CurvePoint
from tests.pipeline.compared import arm, compared, scored

ENERGY, SKILL = "proper/energy", "proper/skill_persistence/energy"


def point(line, at, energy, **more):
    method = arm(f"{line}-{at}", curve=CurvePoint(line, at))
    numbers = {ENERGY: (energy, energy - 1, energy + 1), "proper/w1/stop": 0.5}
    return scored(method, 0, {"scene": {}}, numbers=numbers, **more)


FOUND = compared(
    [
        point("towns first", 150, 6.0),
        point("real alone", 50, 9.0),
        point("towns first", 50, 7.0),
        scored(arm("other"), 0, {"scene": {}}, numbers={ENERGY: 5.0}),
    ]
)


def test_points_stand_line_by_line_from_few_to_many():
    placed = [(line, x) for line, x, _ in points(FOUND)]

    assert placed == [("towns first", 50), ("towns first", 150), ("real alone", 50)]


def test_the_table_has_each_score_with_its_interval():
    table = learning_curve(FOUND)

    assert table.columns[:3] == ["line", "scenes shown in training", "energy score"]
    means = [row[2].mean for row in table.rows]
    assert means == [7.0, 6.0, 9.0]
    assert (table.rows[0][2].low, table.rows[0][2].high) == (6.0, 8.0)
    assert table.rows[0][3] is None  # The skill was not measured.


def test_every_proper_score_of_every_point_is_a_row():
    rows = learning_curve_scores(FOUND).rows

    assert len(rows) == 3 * 2
    assert {row[3] for row in rows} == {"energy", "w1/stop"}


def test_a_chart_has_a_line_for_each_line_and_a_logarithmic_axis():
    (chart,) = learning_curve_charts(FOUND, "")

    assert chart.title == "Learning curve: energy score"
    svg = chart.to_svg()
    assert "towns first" in svg
    assert "real alone" in svg


def test_a_comparison_without_points_has_no_learning_curve():
    found = compared([scored(arm("other"), 0, {"scene": {}}, numbers={ENERGY: 5.0})])

    assert learning_curve(found).rows == []
    assert learning_curve_scores(found).rows == []
    assert list(learning_curve_charts(found, "")) == []


def test_an_arm_that_was_not_planned_and_names_no_place_is_no_point():
    method = arm("unknown", curve=CurvePoint("line"))
    found = compared([scored(method, 0, {"scene": {}}, numbers={ENERGY: 5.0})])

    assert points(found) == []
