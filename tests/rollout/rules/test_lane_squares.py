"""Squares of lane segments tell what a look at all segments tells."""

import numpy as np
import pytest

from infgen.rollout.rules.lane_squares import LaneSquares, lane_gap_m


@pytest.mark.parametrize("reach_m", [0.0, 4.0, 25.0, 1e6])
def test_points_near_a_lane_are_those_near_any_segment(reach_m):
    random = np.random.default_rng(0)
    lanes = [
        (
            random.uniform(-at_m, at_m, (count, 2)).astype(np.float32),
            random.uniform(-5, 5, (count, 2)).astype(np.float32),
        )
        for at_m, count in ((100, 60), (30, 7), (1, 0))
    ]
    xy_m = random.uniform(-150, 150, (3000, 2)).astype(np.float32)
    scene = random.integers(0, len(lanes), len(xy_m))

    found = LaneSquares.of(lanes, reach_m).has_lane(xy_m, scene)

    gap_m = [
        lane_gap_m(point_m, *lanes[at]).min(initial=np.inf)
        for point_m, at in zip(xy_m, scene, strict=True)
    ]
    np.testing.assert_array_equal(found, np.array(gap_m) <= reach_m)
    assert not found[scene == 2].any()


def test_a_point_on_the_lane_and_one_at_its_very_distance():
    lanes = [(np.zeros((1, 2), np.float32), np.array([[4, 0]], np.float32))]
    squares = LaneSquares.of(lanes, 3.0)
    points_m = np.array([[2, 0], [2, 3], [2, 3.01], [-3, 0], [7.01, 0]], np.float32)

    found = squares.has_lane(points_m, np.zeros(5, dtype=np.int64))

    assert found.tolist() == [True, True, False, True, False]
