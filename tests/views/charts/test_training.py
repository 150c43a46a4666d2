import xml.etree.ElementTree as ET

import numpy as np
import pytest

from infgen.views.charts.calibration import Bins
from infgen.views.charts.canvas import COLOURS
from infgen.views.charts.lines import Series
from infgen.views.charts.training import Run, figure_chart, running_mean, training_charts

SVG = "{http://www.w3.org/2000/svg}"


def line(y):
    y = np.array(y, float)
    return Series("", 10 * np.arange(1.0, len(y) + 1), y)


def run(name="a", validation_split=None, **train):
    validation = {figure: line(y) for figure, y in (validation_split or {}).items()}
    curves = {figure: line(y) for figure, y in train.items()}
    return Run(name, curves, validation=validation)


def drawn(runs, figure="motion"):
    return figure_chart(runs, figure, "Moves", "loss")


def axes(chart):
    (found,) = chart.figure.axes
    return found


def curves(chart, colour):
    """Lines of a colour that have points, the legend's left out."""
    lines = axes(chart).get_lines()
    return [line for line in lines if line.get_color() == colour and len(line.get_xdata())]


def texts(chart):
    return [text.text for text in ET.fromstring(chart.to_svg()).iter(f"{SVG}text")]


def test_a_running_mean_of_a_straight_line_is_that_line_away_from_the_ends():
    values = np.arange(400.0)

    found = running_mean(values, np.ones(400))

    assert np.allclose(found[10:-10], values[10:-10])
    assert found[0] == np.mean(values[:11])  # A fortieth to either side.


def test_a_running_mean_weighs_each_value_by_what_it_is_a_mean_over():
    values, weight = np.array([1.0, 4.0] * 50), np.array([3.0, 1.0] * 50)

    found = running_mean(values, weight)

    assert np.all(np.abs(found[10:-10] - 1.75) < 0.2)
    assert np.all(running_mean(values, np.ones(100))[10:-10] > 2.3)


def test_unknown_values_do_not_count_in_a_running_mean():
    values = np.full(200, 2.0)
    values[::3] = np.nan

    assert np.allclose(running_mean(values, np.ones(200)), 2.0)
    assert np.isnan(running_mean(np.full(50, np.nan), np.ones(50))).all()


def test_a_chart_has_a_bold_line_its_span_and_a_dashed_one_with_dots():
    falling = 1 + 5 / np.arange(1, 101)

    chart = drawn([run(motion=falling, validation_split={"motion": [4.0, 2.0, 1.5]})])

    bold, dashed = curves(chart, COLOURS[0])
    assert len(axes(chart).collections) == 1
    assert (bold.get_marker(), dashed.get_marker()) == ("None", "o")
    assert dashed.get_ydata().tolist() == [4.0, 2.0, 1.5]
    assert {"Moves", "step", "loss", "a", "held-out"} <= set(texts(chart))


def test_several_runs_share_a_chart_each_in_its_colour_and_named():
    runs = [run("InfGen", motion=[3, 2, 1], add=[1, 1, 1]), run("SMART", motion=[4, 3, 2])]

    both, one = drawn(runs), drawn(runs, "add")

    assert {"InfGen", "SMART"} <= set(texts(both))
    assert len(curves(both, COLOURS[1])) == 1
    assert "SMART" not in texts(one)


def test_a_run_keeps_its_colour_in_charts_that_others_are_not_in():
    runs = [run("a", add=[1, 2]), run("b", add=[1, 2], motion=[1, 2])]

    assert curves(drawn(runs), COLOURS[1])
    assert not curves(drawn(runs), COLOURS[0])


def test_a_loss_that_falls_far_stands_on_a_logarithmic_axis():
    far, near = (
        drawn([run(motion=[100.0, 10.0, 0.5])]),
        drawn([run(motion=[7.0, 6.0, 5.0])]),
    )

    assert {"0.5", "5", "50"} <= set(texts(far))
    assert {"5.0", "6.0", "7.0"} <= set(texts(near))


def test_the_unit_of_a_loss_is_nats_where_tokens_are_chosen():
    token = run(heading=[2.0, 1.0], heading_accuracy=[0.1, 0.2], size=[3.0, 2.0])
    angle = run(heading=[2.0, 1.0])

    heading, size = training_charts([token])
    both, _ = training_charts([token, angle])

    assert "loss, nats" in texts(heading)
    assert "squared error" in texts(size)
    assert "loss" in texts(both)


def test_single_values_far_off_do_not_squash_the_chart():
    values = np.full(1000, 2.0) + np.linspace(0.5, 0, 1000)
    values[500] = 1000.0

    assert axes(drawn([run(gradient_norm=values)], "gradient_norm")).get_ylim()[1] < 100


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("values", [[1.0], [np.nan, np.nan], [0.0, 0.0, 0.0]])
def test_a_log_of_little_or_nothing_is_still_drawn(values):
    svg = drawn([run(motion=values)]).to_svg()

    assert "nan" not in svg.lower()


def test_a_thousand_steps_take_no_more_points_than_can_be_told_apart():
    noisy = np.random.default_rng(0).normal(size=20000)

    assert len(drawn([run(motion=noisy)]).to_svg()) < 40_000


def test_all_that_was_logged_is_drawn_in_a_fixed_order_and_nothing_else():
    bins = Bins(np.array([10.0]), np.array([2.0]), np.array([3.0]))
    full = Run(
        "a",
        {name: line([2.0, 1.0]) for name in ("add", "motion", "motion_accuracy", "odd")},
        validation={"total": line([9.0])},
        bins={"keep": bins, "add": bins},
    )

    assert [chart.title for chart in training_charts([full])] == [
        "Motion token",
        "Add or begin motion",
        "All terms, weighted",
        "Accuracy of motion tokens",
        "Removal: predicted and logged",
        "Insertion: predicted and logged",
    ]
    assert training_charts([]) == []
