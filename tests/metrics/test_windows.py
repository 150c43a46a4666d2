import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.metrics.windows import Windows, cut_windows


def test_thirty_seconds_hold_forty_five_windows():
    windows = cut_windows(300, 8.0, 0.5)

    assert windows.count == 45
    assert (windows.length, windows.stride) == (16, 1)
    assert windows.starts[-1] + windows.length == 60


@pytest.mark.parametrize(("steps", "count"), [(80, 1), (84, 1), (85, 2), (79, 0), (0, 0)])
def test_only_whole_windows_count(steps, count):
    assert cut_windows(steps, 8.0, 0.5).count == count


def test_durations_that_are_no_whole_half_seconds_are_refused():
    with pytest.raises(ValueError, match="not a whole number"):
        cut_windows(300, 8.1, 0.5)


@given(
    tokens=st.integers(1, 40),
    length=st.integers(1, 20),
    stride=st.integers(1, 5),
    seed=st.integers(0, 999),
)
def test_sums_are_those_of_slices(tokens, length, stride, seed):
    windows = Windows(tokens, length, stride)
    steps = np.random.default_rng(seed).integers(0, 9, (3, tokens * 5 + 3))

    found = windows.sum_steps(steps)

    assert found.shape == (3, windows.count)
    for at, start in enumerate(windows.starts):
        cut = steps[:, start * 5 : (start + length) * 5]
        np.testing.assert_array_equal(found[:, at], cut.sum(axis=1))


@given(tokens=st.integers(16, 40), token=st.integers(0, 39))
def test_covering_windows_are_those_that_hold_the_token(tokens, token):
    windows = Windows(tokens, 16, 1)

    covered = windows.covering(np.array([token]))[0]
    expected = [start <= token < start + 16 for start in windows.starts]
    np.testing.assert_array_equal(covered, expected)
