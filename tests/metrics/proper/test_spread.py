import numpy as np

from infgen.metrics.proper.spread import (
    flatness_error,
    rank_counts,
    spread_and_error,
    spread_skill,
)


def test_a_truth_ranks_by_the_members_below_it_and_ties_are_shared():
    members = np.array([[0.0, 1.0, 5.0], [1.0, 1.0, 6.0], [2.0, 4.0, 7.0]])
    truth = np.array([1.5, 1.0, np.nan])

    counts = rank_counts(members, truth)

    # The first is above two; the second could be at 0, 1 or 2; the third is not known.
    np.testing.assert_allclose(counts, [1 / 3, 1 / 3, 1 / 3 + 1, 0])


def test_a_flat_histogram_has_no_error_and_one_of_a_single_rank_the_most():
    counts = np.array([[2.0, 2.0, 2.0, 2.0], [8.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])

    np.testing.assert_allclose(flatness_error(counts), [0.0, 1.5, np.nan])


def test_spread_is_corrected_for_the_number_of_members():
    members, truth = np.array([[0.0], [2.0]]), np.array([3.0])

    variance, error = spread_and_error(members, truth)

    np.testing.assert_allclose(variance, [3.0])  # 3 / 2 of the variance 2.
    np.testing.assert_allclose(error, [4.0])
    np.testing.assert_allclose(spread_skill(variance, error), [np.sqrt(0.75)])


def test_without_error_or_a_second_member_there_is_no_ratio():
    one = spread_and_error(np.array([[1.0]]), np.array([2.0]))

    assert np.isnan(one).all()
    assert np.isnan(spread_skill(np.array([1.0]), np.array([0.0]))).all()
