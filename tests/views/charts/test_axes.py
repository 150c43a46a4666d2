import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.views.charts.axes import Axis, decade_ticks, fit, line_path


def test_equal_ratios_are_equally_far_apart_on_a_logarithmic_axis():
    axis = Axis(0.01, 100.0, 0.0, 400.0, logarithmic=True)

    assert [axis.px(value) for value in (0.01, 0.1, 1.0, 10.0, 100.0)] == pytest.approx(
        [0, 100, 200, 300, 400]
    )


def test_what_a_logarithmic_axis_cannot_hold_stands_at_its_start():
    axis = Axis(0.01, 1.0, 10.0, 20.0, logarithmic=True)

    assert axis.px(0.0) == axis.px(-3.0) == axis.px(0.001) == 10.0


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.03, 0.4, [0.02, 0.05, 0.1, 0.2, 0.5]),
        (1.0, 10.0, [1, 2, 5, 10]),
        (3.0, 4.0, [2, 5]),
        (2e-7, 4e-4, [1e-7, 1e-6, 1e-5, 1e-4, 1e-3]),
        (1.0, 1e24, [1, 1e3, 1e6, 1e9, 1e12, 1e15, 1e18, 1e21, 1e24]),
    ],
)
def test_logarithmic_ticks_are_round_numbers_around_the_range(low, high, expected):
    assert decade_ticks(low, high) == pytest.approx(expected)


@given(st.floats(-9, 6), st.floats(0.01, 90))
def test_logarithmic_ticks_always_span_the_range(power, decades):
    low, high = 10.0**power, 10.0 ** (power + decades)

    marks = decade_ticks(low, high)

    assert marks[0] <= low * (1 + 1e-6)
    assert marks[-1] >= high * (1 - 1e-6)
    assert 2 <= len(marks) <= 11


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("values", [[], [np.nan], [0.3], [0.0, 0.0], [0.0, 4.0, np.nan]])
def test_few_values_or_none_have_a_scale_too(values, logarithmic):
    axis, marks = fit([np.array(values)], 0.0, 100.0, logarithmic=logarithmic)

    assert axis.low < axis.high
    assert len(marks) >= 2
    assert np.isfinite([axis.px(mark) for mark in marks]).all()


def test_a_line_breaks_at_gaps_and_tells_points_it_cannot_show():
    axis = Axis(0.0, 10.0, 0.0, 10.0)
    y = np.array([0.0, 1.0, np.nan, 3.0, np.nan, 5.0, 6.0])

    path, alone = line_path(np.arange(7.0), y, axis, axis)

    assert path == "M0.0 0.0L1.0 1.0M3.0 3.0M5.0 5.0L6.0 6.0"
    assert alone == [(3.0, 3.0)]
