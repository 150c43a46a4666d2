import xml.etree.ElementTree as ET

import numpy as np
import pytest
from matplotlib.colors import to_hex

from infgen.views.charts.canvas import COLOURS, INK
from infgen.views.charts.lines import Interval, Series, interval_chart, line_chart

SVG = "{http://www.w3.org/2000/svg}"
NAN = float("nan")


def series(y, name="a"):
    y = np.array(y, float)
    return Series(name, np.arange(len(y), dtype=float), y)


def chart(*lines, truth=None):
    return line_chart(list(lines), truth, title="t", x_label="x", y_label="y")


def axes(chart):
    (found,) = chart.figure.axes
    return found


def named(chart):
    """Lines that stand in the legend, by their names."""
    return {
        line.get_label(): line for line in axes(chart).get_lines() if line.get_xdata().size
    }


def texts(chart):
    return [text.text for text in ET.fromstring(chart.to_svg()).iter(f"{SVG}text")]


def test_a_line_has_its_points_and_a_name():
    (line,) = axes(chart(series([0.0, 10.0]))).get_lines()[:1]

    assert line.get_xdata().tolist() == [0.0, 1.0]
    assert line.get_ydata().tolist() == [0.0, 10.0]
    assert {"a", "t", "x", "y"} <= set(texts(chart(series([0.0, 10.0]))))


def test_a_lone_point_between_gaps_is_a_dot():
    lines = axes(chart(series([0.0, 1.0, NAN, 2.0, NAN, 3.0, 4.0]))).get_lines()

    assert lines[1].get_xdata().tolist() == [3.0]
    assert lines[1].get_marker() == "o"


@pytest.mark.parametrize("count", [1, 7, 12, 36])
def test_no_two_methods_look_alike_however_many_there_are(count):
    drawn = chart(*[series([0.0, at], f"m{at}") for at in range(count)])
    lines = [axes(drawn).get_lines()[2 * at] for at in range(count)]

    looks = {(line.get_color(), str(line._dash_pattern)) for line in lines}
    assert len(looks) == count


def test_the_truth_is_drawn_in_ink_and_named_last():
    drawn = chart(series([0.0, 1.0], "one"), truth=series([1.0, 1.0], "the logs"))

    assert to_hex(axes(drawn).get_lines()[2].get_color()) == INK
    words = [text.get_text() for text in axes(drawn).get_legend().get_texts()]
    assert words == ["one", "the logs"]


@pytest.mark.parametrize("count", [1, 4, 9, 14])
def test_the_legend_lies_within_the_chart(count):
    drawn = chart(*[series([0.0, at], f"method {at}") for at in range(count)])
    figure = drawn.figure
    figure.draw_without_rendering()
    box = figure.axes[0].get_legend().get_window_extent()

    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.y1 < figure.axes[0].xaxis.label.get_window_extent().y1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("y", [[], [NAN, NAN], [5.0, 5.0], [0.0]])
def test_a_chart_of_little_or_nothing_is_still_a_chart(y):
    svg = chart(series(y)).to_svg()

    assert ET.fromstring(svg).get("role") == "img"
    assert "nan" not in svg.lower()
    assert "a" in texts(chart(series(y)))


def test_words_are_escaped_wherever_they_stand():
    nasty = "<script>alert('&')</script>"
    line = Series(nasty, np.arange(2.0), np.arange(2.0))
    rows = [Interval(nasty, 0.5, 0.4, 0.6, 0.7)]
    for drawn in (
        line_chart([line], title=nasty, x_label=nasty, y_label=nasty),
        interval_chart(rows, title=nasty, x_label=nasty, reference=nasty),
    ):
        assert "<script" not in drawn.to_svg()
        assert nasty in texts(drawn)


def test_numbers_stand_on_their_intervals_beside_what_they_are_compared_with():
    rows = [Interval("a", 0.5, 0.25, 0.75, 1.0), Interval("b", 0.0, 0.0, 0.0, 0.0)]
    drawn = interval_chart(rows, title="t", x_label="x", reference="log")

    rings, dots = axes(drawn).get_lines()
    assert rings.get_xdata().tolist() == [1.0, 0.0]
    assert dots.get_xdata().tolist() == [0.5, 0.0]
    (intervals,) = axes(drawn).collections
    assert intervals.get_segments()[0].tolist() == [[0.25, 0.0], [0.75, 0.0]]
    assert to_hex(dots.get_color()) == COLOURS[0]


@pytest.mark.filterwarnings("error")
def test_numbers_that_are_unknown_stay_empty_but_named():
    rows = [Interval("none", NAN, NAN, NAN, NAN), Interval("b", 1.0, 0.5, 1.5, NAN)]

    assert {"none", "b"} <= set(
        texts(interval_chart(rows, title="t", x_label="x", reference="log"))
    )
    interval_chart([], title="t", x_label="x", reference="log").to_svg()
