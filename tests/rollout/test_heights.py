"""Boxes stand on the road point that is nearest, wherever it is."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.rollout.heights import SQUARE_M, ground_z_m


@given(
    seed=st.integers(0, 2**32 - 1),
    roads=st.integers(1, 400),
    spread_m=st.sampled_from([3.0, 40.0, 600.0]),
)
@settings(max_examples=60)
def test_the_nearest_road_point_is_found_as_if_all_were_asked(seed, roads, spread_m):
    rng = np.random.default_rng(seed)
    road_xy_m = rng.uniform(-spread_m, spread_m, (roads, 2)).astype(np.float32)
    xy_m = rng.uniform(-2 * spread_m, 2 * spread_m, (50, 2)).astype(np.float32)
    row = np.arange(roads, dtype=np.float32)

    found = ground_z_m(xy_m, road_xy_m, row).astype(np.int64)

    away_m = np.linalg.norm(xy_m[:, None].astype(float) - road_xy_m, axis=-1)
    own_m = away_m[np.arange(len(xy_m)), found]
    np.testing.assert_allclose(own_m, away_m.min(axis=1), atol=1e-2)


def test_a_point_at_the_rim_of_its_square_may_stand_on_a_road_of_another():
    road_xy_m = np.float32([[-0.5, 8.0], [SQUARE_M / 2, 8.0]])

    found = ground_z_m(np.float32([[0.1, 8.0]]), road_xy_m, np.float32([3.0, 4.0]))

    assert found.tolist() == [3.0]


def test_on_an_empty_map_the_ground_is_level():
    nothing, points = np.zeros((0, 2), np.float32), np.ones((2, 2), np.float32)
    heights_m = np.ones(2, np.float32)

    assert ground_z_m(points, nothing, heights_m[:0]).tolist() == [0, 0]
    assert not len(ground_z_m(nothing, points, heights_m))
