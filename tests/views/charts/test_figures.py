import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.views.charts.axes import ticks
from infgen.views.charts.figures import Interval, Series, interval_chart, line_chart

SVG = "{http://www.w3.org/2000/svg}"


def drawn(svg):
    """Parse a drawing; it must be well-formed."""
    return ET.fromstring(svg)


def texts(root):
    return [element.text for element in root.iter(f"{SVG}text")]


def paths(root, look):
    return [p.get("d") for p in root.iter(f"{SVG}path") if look in p.get("class").split()]


def chart(*series):
    return drawn(line_chart(series, title="t", x_label="x", y_label="y"))


def line(y, name="a"):
    y = np.array(y, float)
    return Series(name, np.arange(len(y), dtype=float), y)


def points(path):
    return [
        tuple(map(float, pair)) for pair in re.findall(r"[ML]([\d.-]+) ([\d.-]+)", path)
    ]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 10.0, [0, 2, 4, 6, 8, 10]),
        (0.0, 1.0, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (0.13, 0.47, [0.1, 0.2, 0.3, 0.4, 0.5]),
        (-3.0, 4.0, [-4, -2, 0, 2, 4]),
        (0.0, 45.0, [0, 10, 20, 30, 40, 50]),
    ],
)
def test_ticks_are_round_numbers_around_the_range(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_always_span_the_range_with_few_even_steps(low, size):
    marks = ticks(low, low + size)

    assert marks[0] <= low + 1e-6 * size
    assert marks[-1] >= low + size * (1 - 1e-6)
    assert 2 <= len(marks) <= 8
    assert np.allclose(np.diff(marks), marks[1] - marks[0])


def test_a_line_goes_through_its_points_from_left_to_right_and_bottom_to_top():
    (path,) = paths(chart(line([0.0, 10.0])), "d0")[:1]

    (x0, y0), (x1, y1) = points(path)
    assert (x0, x1) == (58.0, 506.0)
    assert (y0, y1) == (234.0, 34.0)


def test_a_line_breaks_where_a_value_is_missing_and_a_lone_point_is_a_dot():
    root = chart(line([0.0, 1.0, np.nan, 2.0, np.nan, 3.0, 4.0]))

    path = paths(root, "d0")[0]
    assert (path.count("M"), path.count("L")) == (3, 2)
    assert len(list(root.iter(f"{SVG}circle"))) == 1


def test_every_line_is_named_and_has_its_own_colour_and_dash():
    root = chart(
        line([0.0, 1.0], "one"), line([1.0, 2.0], "two"), line([2.0, 3.0], "three")
    )

    assert {"one", "two", "three"} <= set(texts(root))
    for at in range(3):
        assert len(paths(root, f"c{at}")) == len(paths(root, f"d{at}")) == 2


@pytest.mark.parametrize("y", [[], [np.nan, np.nan], [5.0, 5.0], [0.0]])
def test_a_chart_of_little_or_nothing_is_still_a_chart(y):
    root = chart(line(y))

    assert root.get("role") == "img"
    assert "nan" not in ET.tostring(root, encoding="unicode").lower()


def test_words_are_escaped_wherever_they_stand():
    nasty = "<script>alert('&')</script>"
    series = Series(nasty, np.arange(2.0), np.arange(2.0))
    rows = [Interval(nasty, 0.5, 0.4, 0.6, 0.7)]
    for svg in (
        line_chart([series], title=nasty, x_label=nasty, y_label=nasty),
        interval_chart(rows, title=nasty, x_label=nasty, reference=nasty),
    ):
        assert "<script" not in svg
        assert nasty in texts(drawn(svg))


def test_numbers_stand_on_their_intervals_beside_what_they_are_held_against():
    rows = [Interval("a", 0.5, 0.25, 0.75, 1.0), Interval("b", 0.0, 0.0, 0.0, 0.0)]

    root = drawn(interval_chart(rows, title="t", x_label="x", reference="log"))

    circles = [(c.get("class"), float(c.get("cx"))) for c in root.iter(f"{SVG}circle")]
    left, right = 190.0, 506.0
    assert circles[0] == ("c1 ring", right)
    assert circles[1] == ("c0 dot", (left + right) / 2)
    assert paths(root, "line")[0] == f"M{left + 0.25 * (right - left):.1f} 45H427.0"


def test_numbers_that_are_unknown_stay_empty():
    nan = float("nan")
    rows = [Interval("a", nan, nan, nan, nan), Interval("b", 1.0, 0.5, 1.5, nan)]

    root = drawn(interval_chart(rows, title="t", x_label="x", reference="log"))

    dots = [c for c in root.iter(f"{SVG}circle") if c.get("class") == "c0 dot"]
    assert len(dots) == 2  # One, and the one of the key.
    assert {"a", "b"} <= set(texts(root))
