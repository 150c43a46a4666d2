"""Gradient of an energy score."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.model.training.policy_gradient.energy import energy_gradient

VALUES = st.lists(st.floats(-50, 50, width=32), max_size=12)


@given(VALUES, VALUES)
def test_it_is_the_mean_distance_to_the_log_less_that_to_the_others(values, logged):
    ours, logs = np.float32(values), np.float32(logged)

    found = energy_gradient(ours, logs)

    if len(ours) < 2 or not len(logs):
        assert not found.any()
        return
    to_log = np.abs(ours[:, None] - logs).mean(axis=1)
    to_others = np.abs(ours[:, None] - ours).sum(axis=1) / (len(ours) - 1)
    assert found == pytest.approx(to_log - to_others, abs=1e-4)


def test_one_alone_or_no_log_costs_nothing():
    one, none = np.float32([1]), np.float32([])

    assert energy_gradient(one, one).tolist() == [0]
    assert energy_gradient(np.float32([1, -1]), none).tolist() == [0, 0]


def test_the_gradient_is_zero_where_the_share_is_the_logs_and_points_to_it():
    """Off with share q of the rollouts and p of the log: what off costs more than on."""

    def excess(q, p, count=1000):
        ours, logs = (
            np.repeat(
                np.float32([1, -1]), [round(share * count), count - round(share * count)]
            )
            for share in (q, p)
        )
        cost = energy_gradient(ours, logs)
        return float(cost[0] - cost[-1])

    assert excess(0.5, 0.5) == pytest.approx(0, abs=1e-5)
    assert excess(0.7, 0.5) == pytest.approx(4 * 0.2, rel=0.01)
    assert excess(0.2, 0.5) == pytest.approx(-4 * 0.3, rel=0.01)
