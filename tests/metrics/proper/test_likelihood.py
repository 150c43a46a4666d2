import numpy as np
import pytest

from infgen.metrics.long_term.protocols import ROW, STEP_FEATURES
from infgen.metrics.proper.likelihood import count_log_likelihood, step_log_likelihood
from infgen.metrics.proper.outcomes import GONE, UNKNOWN

SPEED, COLLISION = ROW["linear_speed"], ROW["collision_indication"]


def log_p(logged, members, row, windows=1):
    """Log-likelihood of one feature of one agent, from outcomes step by step."""
    log = np.full((len(STEP_FEATURES), 1, len(logged)), UNKNOWN, dtype=np.uint8)
    pool = np.full((len(members), *log.shape), UNKNOWN, dtype=np.uint8)
    log[row, 0], pool[:, row, 0] = logged, members
    return step_log_likelihood(log, pool, windows)[row]


def test_the_steps_of_all_rollouts_are_one_pool():
    # Ten bins and being gone; of four values three are in bin 2.
    found = log_p([2, 3], [[2, 2], [2, 3]], SPEED)

    total = 4 + 11 * 0.1
    expected = (np.log(3.1 / total) + np.log(1.1 / total)) / 2
    np.testing.assert_allclose(found, [expected])


def test_each_window_has_a_pool_of_its_own_and_what_is_not_known_counts_nowhere():
    found = log_p([2, UNKNOWN, 3, 3], [[2, 2, UNKNOWN, 5]], SPEED, windows=2)

    np.testing.assert_allclose(found, [np.log(2.1 / (2 + 1.1)), np.log(0.1 / (1 + 1.1))])


def test_being_gone_is_foreseen_or_not():
    leaves = log_p([GONE], [[GONE], [2]], SPEED)
    empty = log_p([2], [[GONE], [GONE]], SPEED)

    np.testing.assert_allclose(leaves, [np.log(1.1 / 3.1)])
    np.testing.assert_allclose(empty, [np.log(0.1 / 3.1)])


@pytest.mark.parametrize(
    ("logged", "count"),
    [([0, 1, 0], 2), ([0, UNKNOWN, 0], 1), ([GONE, GONE, GONE], 1)],
)
def test_an_event_happens_in_a_window_or_does_not_or_the_agent_is_gone(logged, count):
    members = [[0, 0, 1], [1, 1, 1], [0, 0, UNKNOWN], [GONE, GONE, GONE]]

    found = log_p(logged, members, COLLISION)

    np.testing.assert_allclose(found, [np.log((count + 0.1) / 4.3)])


def test_what_is_measured_nowhere_has_no_likelihood():
    assert np.isnan(log_p([UNKNOWN], [[2]], SPEED)).all()


def test_counts_are_likely_where_rollouts_count_as_many():
    truth = np.array([[1.0, 0.0], [9.0, np.nan]])
    members = np.array([[[1.0, 0.0], [3.0, 0.0]], [[2.0, 0.0], [8.0, 0.0]]])

    found = count_log_likelihood(truth, members, most=3)

    # Four outcomes: 0, 1, 2, 3 or more. Half of the members, and all; then all of one ring.
    half, all_of_them = np.log(1.1 / 2.4), np.log(2.1 / 2.4)
    np.testing.assert_allclose(found, [(half + all_of_them) / 2, all_of_them])
