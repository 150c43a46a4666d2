"""Which side of which edge: drawn on paper, and against trying all segments."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from infgen.spatial.nearest import nearest_by_cells
from infgen.spatial.road_edges import NONE, RoadError, build_road_edges, signed_distance_m


def line(*xy, z=0.0):
    points = np.array([(x, y, z) for x, y in xy], dtype=np.float32)
    return points


def at(edges, *points):
    return signed_distance_m(np.array(points, dtype=np.float32), edges)


EAST = build_road_edges([line((0, 0), (10, 0), (20, 0))])


def test_left_of_an_edge_is_on_the_road_and_negative():
    np.testing.assert_allclose(at(EAST, (5, 3, 0), (5, -3, 0), (5, 0, 0)), [-3, 3, 0])


def test_beyond_the_end_of_an_edge_the_distance_is_to_its_end():
    assert at(EAST, (23, 4, 0))[0] == pytest.approx(-5.0)


def test_a_bridge_overhead_does_not_catch_the_cars_below():
    # The bridge's edge is right above, 5 m up: 15 m away when heights weigh threefold.
    edges = build_road_edges([line((0, 0), (20, 0)), line((0, 8), (20, 8), z=5.0)])

    assert at(edges, (10, 7.9, 0))[0] == pytest.approx(-7.9)


def test_inside_a_convex_corner_both_segments_must_agree_it_is_off_the_road():
    # A left turn: the road is inside it. Beyond the vertex the larger sign counts.
    left = build_road_edges([line((0, 0), (10, 0), (10, 10))])
    right = build_road_edges([line((0, 0), (10, 0), (10, -10))])

    assert at(left, (11, -1, 0))[0] > 0
    assert at(right, (11, 1, 0))[0] < 0
    assert at(left, (9, 1, 0))[0] < 0
    assert at(right, (9, -1, 0))[0] > 0


def square(size, closed=True):
    corners = [(0, 0), (size, 0), (size, size), (0, size), (0, 0)]
    return line(*corners[: 5 if closed else 4])


def test_an_edge_is_closed_only_if_no_other_has_more_points():
    alone = build_road_edges([square(10)])
    beside = build_road_edges([square(10), line(*[(50 + i, 50) for i in range(9)])])

    assert (alone.before[0], alone.after[3]) == (3, 0)
    assert (beside.before[0], beside.after[3]) == (NONE, NONE)


def test_a_closed_edge_is_looked_at_around_its_seam():
    closed = build_road_edges([square(10)])

    assert at(closed, (-1, -2, 0))[0] == pytest.approx(np.hypot(1, 2), rel=1e-5)


def test_edges_of_one_point_are_left_out_and_none_at_all_is_an_error():
    assert len(build_road_edges([line((0, 0)), line((0, 0), (1, 0))]).start_m) == 1
    with pytest.raises(RoadError, match="no road edge"):
        build_road_edges([line((0, 0))])


def test_a_point_that_is_given_twice_makes_no_nan():
    doubled = build_road_edges([line((0, 0), (0, 0), (10, 0))])

    assert np.isfinite(at(doubled, (5, 1, 0), (-1, 0, 0))).all()


def every_distance_m(points, start, along):
    to = points[:, None] - start
    length = (along[:, :2] ** 2).sum(-1)
    share = (to[..., :2] * along[:, :2]).sum(-1) / np.where(length > 0, length, 1)
    gap = to - along * np.clip(share, 0, 1)[..., None]
    return np.linalg.norm(gap, axis=-1)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    segments=st.integers(1, 300),
    spread_m=st.floats(1.0, 500.0),
)
@example(seed=1, segments=82, spread_m=1.0)  # A segment that is nearly upright.
def test_cells_find_the_segment_that_trying_all_finds(seed, segments, spread_m):
    random = np.random.default_rng(seed)
    start = random.uniform(-spread_m, spread_m, (segments, 3)).astype(np.float32)
    along = random.normal(0, 3, (segments, 3)).astype(np.float32)
    along[::7] = 0
    points = random.uniform(-2 * spread_m, 2 * spread_m, (80, 3)).astype(np.float32)

    found = nearest_by_cells(points, start, along)

    gaps = every_distance_m(points.astype(np.float64), start, along)
    least = gaps.min(axis=1)
    np.testing.assert_allclose(gaps[np.arange(80), found], least, rtol=1e-5, atol=1e-4)


def test_of_equally_near_segments_the_first_is_found():
    start = np.zeros((5, 3), np.float32)
    along = np.tile(np.array([1, 0, 0], np.float32), (5, 1))

    assert nearest_by_cells(np.array([[0.5, 2, 0]], np.float32), start, along)[0] == 0


def test_no_points_have_no_nearest():
    some = np.ones((3, 3), np.float32)

    assert nearest_by_cells(np.zeros((0, 3), np.float32), some, some).shape == (0,)
