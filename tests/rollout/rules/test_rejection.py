"""How far ahead a car looks: as far as it needs to stop."""

import numpy as np
import pytest

from infgen.rollout.rules.off_road import RoadEdgeTiles
from infgen.rollout.rules.rejection import MotionCheck
from tests.rollout.rules.test_collision import everyone
from tests.rollout.rules.test_off_road import street


@pytest.mark.parametrize(
    ("move_m", "heading_rad", "found"),
    [
        # 2 m of road beside it: at 0.1 rad it leaves the road after some 18 m.
        (3, 0.1, False),  # 6 m/s: a second ahead, 6 m.
        (5, 0.1, False),  # 10 m/s: three token steps, 15 m.
        (8, 0.1, True),  # 16 m/s: two seconds, 32 m.
        (20, 0.1, True),
        (20, 0.015, False),  # After 131 m, but no more than 2.5 s are looked ahead.
        (1, np.pi / 2, True),  # Across, its nose 1 m from the edge.
        (0, np.pi / 2, False),
    ],
)
def test_a_car_looks_as_far_ahead_as_it_needs_to_stop(
    metre_moves, move_m, heading_rad, found
):
    one_map = np.zeros(1, dtype=np.int64)
    motion_check = MotionCheck(metre_moves, [RoadEdgeTiles(street())], one_map)
    motion_token, drawn = np.array([[move_m]]), np.ones((1, 1), dtype=bool)

    hits, departs = motion_check.rejects(
        everyone((-50, 0, heading_rad)), motion_token, drawn, road=True
    )

    assert (hits.item(), departs.item()) == (False, found)


def test_who_is_fast_and_whose_move_is_slower(metre_moves):
    """Two token steps are enough to stop from 8 m/s."""
    cars = everyone((0, 0, 0), (9, 0, 0), (18, 0, 0))
    motion_check = MotionCheck(metre_moves, [], np.zeros(1, dtype=np.int64))
    moves, others = np.array([[4, 5, 0]]), np.array([[5, 5, 25]])

    assert motion_check.is_fast(cars, moves).tolist() == [[False, True, False]]
    assert motion_check.is_slower(cars, moves, others).tolist() == [[True, False, True]]


def test_only_rollouts_in_which_somebody_drew_are_looked_at_again(metre_moves):
    """In both the second car runs into the first one that stands."""
    one = everyone((9, 0, 0), (0, 0, 0))
    both = one.take(np.array([0, 0]))
    motion_check = MotionCheck(metre_moves, [], np.zeros(2, dtype=np.int64))
    moves, drawn = np.array([[0, 4], [0, 4]]), np.array([[True, True], [False, False]])

    hits, departs = motion_check.rejects(both, moves, drawn, road=True)

    assert hits.tolist() == [[False, True], [False, False]]
    assert not departs.any()
    nobody, _ = motion_check.rejects(both, moves, np.zeros_like(drawn), road=True)
    assert not nobody.any()
