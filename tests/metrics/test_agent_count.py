import numpy as np
import pytest

from infgen.metrics.agent_count import count_errors, mean_counts, truth
from infgen.metrics.windows import cut_windows


def counts_of(*per_second):
    return np.repeat(np.array(per_second, np.int16), 10)


def test_the_mean_count_of_a_window_is_over_its_eighty_steps():
    windows = cut_windows(100, 8.0, 0.5)
    number = counts_of(4, 4, 4, 4, 4, 4, 4, 4, 12, 12)

    # Each token step that the window moves swaps five 4s for five 12s.
    np.testing.assert_allclose(mean_counts(number, windows), [4.0, 4.5, 5.0, 5.5, 6.0])


def test_errors_mean_and_slope_by_hand():
    found = count_errors(np.array([10.0, 12.0, 14.0]), 10.0)

    np.testing.assert_array_equal(found.windows, [0, 2, 4])
    assert found.mean == 2.0
    assert found.slope == pytest.approx(2.0)


def test_too_few_agents_are_as_wrong_as_too_many():
    few, many = (count_errors(np.array([n]), 10.0).mean for n in (7.0, 13.0))

    assert few == many == 3.0


def test_one_window_has_no_slope():
    assert np.isnan(count_errors(np.array([3.0]), 1.0).slope)


def test_an_unknown_reference_gives_no_error():
    found = count_errors(np.array([3.0, 4.0]), float("nan"))

    assert np.isnan(found.mean)
    assert np.isnan(found.slope)


def test_the_truth_is_known_as_far_as_the_log_goes():
    played, log = cut_windows(300, 8.0, 0.5), cut_windows(187, 8.0, 0.5)
    number = np.full(187, 5, np.int16)

    known = truth(number, played, log)

    assert log.count == 22
    np.testing.assert_array_equal(known[:22], 5.0)
    assert np.isnan(known[22:]).all()


def test_windows_beyond_the_truth_do_not_count():
    found = count_errors(np.array([3.0, 5.0, 99.0]), np.array([2.0, 2.0, np.nan]))

    assert found.mean == 2.0
    assert found.slope == pytest.approx(2.0)


def test_a_rollout_shorter_than_the_log_uses_the_first_windows_of_the_truth():
    played, log = cut_windows(80, 8.0, 0.5), cut_windows(187, 8.0, 0.5)

    assert truth(np.arange(187, dtype=np.int16), played, log).shape == (1,)
