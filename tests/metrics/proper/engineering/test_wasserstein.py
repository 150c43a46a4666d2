import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.metrics.proper.engineering.wasserstein import BINS, Scale, distance

SCALE = Scale("speed", "m/s", 0.0, 20.0)  # Bins of half a metre per second.


def apart(one, other):
    counts = [SCALE.count(np.array(values, dtype=np.float64)) for values in (one, other)]
    return distance(counts[0][None], counts[1][None], SCALE)[0]


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([1, 2, 3], [1, 2, 3], 0.0),
        ([1, 2, 3], [4, 5, 6], 3.0),
        ([2, 4], [2, 2, 4, 4], 0.0),  # Shares count, not numbers.
        ([0, 10], [5, 5], 5.0),
        ([0, 0, 0, 8], [0, 8, 8, 8], 4.0),
    ],
)
def test_distances_by_hand(one, other, expected):
    assert apart(one, other) == pytest.approx(expected)


@given(
    st.lists(st.floats(0, 19.9), min_size=1, max_size=8),
    st.lists(st.floats(0, 19.9), min_size=1, max_size=8),
)
def test_it_is_the_mean_difference_of_sorted_values_to_within_a_bin(one, other):
    count = len(one) * len(other)
    exact = np.abs(np.sort(one * len(other)) - np.sort(other * len(one))).sum() / count

    assert apart(one, other) == pytest.approx(exact, abs=SCALE.width)
    assert apart(one, other) == pytest.approx(apart(other, one))


def test_values_beyond_the_scale_are_in_its_end_bins_and_nan_nowhere():
    counts = SCALE.count(np.array([-3.0, 99.0, np.nan, 20.0]))

    assert counts[0] == 1
    assert counts[BINS - 1] == 2
    assert counts.sum() == 3


def test_without_values_nothing_is_measured():
    assert np.isnan(apart([], [1.0]))
    assert np.isnan(apart([1.0], []))
