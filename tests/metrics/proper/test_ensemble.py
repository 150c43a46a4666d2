from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.metrics.proper.ensemble import fair_crps, fair_energy, point_energy, skill


def crps(members, truth):
    members = np.array(members, dtype=np.float64)[:, None]
    return fair_crps(members, np.array([truth], dtype=np.float64))[0]


@pytest.mark.parametrize(
    ("members", "truth", "expected"),
    [
        ([0, 2], 1, 0.0),  # Error 1, less 4 / 4.
        ([1, 3], 0, 1.0),  # Error 2, less 4 / 4.
        ([5, 5], 3, 2.0),  # Certain: the absolute error.
        ([0, 0, 3], 1, 4 / 3 - 12 / 12),
    ],
)
def test_crps_by_hand(members, truth, expected):
    assert crps(members, truth) == pytest.approx(expected)


def test_what_is_not_known_has_no_score():
    assert np.isnan(crps([1], 1))
    assert np.isnan(crps([1, np.nan], 1))
    assert np.isnan(crps([1, 2], np.nan))
    assert np.isnan(fair_energy(np.zeros((1, 2)), np.zeros(2))).all()


@pytest.mark.parametrize("members", [2, 3, 5])
def test_the_expectation_does_not_depend_on_the_number_of_members(members):
    # All members and the truth are coins: E|x - y| - E|x - x'| / 2 = 1/2 - 1/4.
    every = [crps(coins[1:], coins[0]) for coins in product((0, 1), repeat=members + 1)]

    assert np.mean(every) == pytest.approx(0.25)


@given(
    st.lists(st.floats(-100, 100), min_size=2, max_size=6),
    st.floats(-100, 100),
    st.floats(-50, 50),
)
def test_energy_of_one_part_is_the_crps_and_moves_with_its_values(members, truth, shift):
    members = np.array(members)[:, None, None]
    energy = fair_energy(members, np.array([[truth]]))[0]

    assert energy == pytest.approx(crps(members[:, 0, 0], truth), abs=1e-9)
    moved = fair_energy(members + shift, np.array([[truth + shift]]))[0]
    assert moved == pytest.approx(energy, abs=1e-9)


def test_energy_by_hand():
    members = np.array([[[0.0, 0.0]], [[6.0, 8.0]]])  # 10 apart.
    truth = np.array([[3.0, 4.0]])  # 5 from both.

    np.testing.assert_allclose(fair_energy(members, truth), [0.0])
    np.testing.assert_allclose(point_energy(members[1], truth), [5.0])


def test_skill_is_1_at_best_and_not_known_against_a_perfect_reference():
    found = skill(np.array([0.0, 1.0, 2.0, 1.0]), np.array([2.0, 2.0, 2.0, 0.0]))

    np.testing.assert_array_equal(found, [1.0, 0.5, 0.0, np.nan])
