"""Routes follow lanes, end where these end, and are found again by whoever drives them."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.environment.route import Route, make_route
from infgen.scene import FeatureType, LaneType, LinkType


def east(first_m, last_m, y_m=0.0):
    x_m = np.arange(first_m, last_m + 1.0)
    return np.column_stack([x_m, 0 * x_m + y_m])


def north(x_m, last_m):
    y_m = np.arange(0, last_m + 1.0)
    return np.column_stack([0 * y_m + x_m, y_m])


@pytest.fixture
def fork(build_map):
    """A lane of 50 m that goes on straight (lane 2) or to the left (lane 3), 100 m each."""
    lanes = [(1, east(-50, 50)), (2, east(50, 150)), (3, north(50, 100))]
    road_map = build_map(
        [(n, FeatureType.LANE, LaneType.SURFACE_STREET, line) for n, line in lanes]
    )
    return replace(
        road_map,
        link_lane_id=np.array([1, 1, 2]),
        link_type=np.array([LinkType.EXIT, LinkType.EXIT, LinkType.ENTRY], dtype=np.int8),
        link_other_id=np.array([2, 3, 1]),
    )


def route_of(scene, seed=0, length_m=1000.0):
    return make_route(scene, np.random.default_rng(seed), length_m, scene.now)


def test_a_route_begins_at_the_ego_and_follows_its_lane(drive):
    # A lane along x from -100 to 100; the ego has driven 10 m of it by now.
    route = route_of(drive(speed_mps=10.0))

    np.testing.assert_allclose(route.xy_m[0], [10.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(route.xy_m[-1], [100.0, 0.0], atol=1e-6)
    assert route.length_m == 90.0


def test_a_route_is_no_longer_than_it_may_be(drive):
    assert route_of(drive(), length_m=25.0).length_m == 25.0


def test_at_a_fork_the_seed_decides(drive, fork):
    scene = drive(road_map=fork)

    ends = [route_of(scene, seed).xy_m[-1].round().tolist() for seed in range(12)]

    assert {tuple(end) for end in ends} == {(150.0, 0.0), (50.0, 100.0)}
    assert ends == [route_of(scene, seed).xy_m[-1].round().tolist() for seed in range(12)]


def test_who_drives_against_a_lane_follows_the_log(drive):
    route = route_of(drive(speed_mps=10.0, heading_rad=np.pi))

    # From x = -10 at now to -90 at the end of the log, and 50 m on.
    np.testing.assert_allclose(route.xy_m[0], [-10.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(route.xy_m[-1], [-140.0, 0.0], atol=0.1)


def test_a_place_on_a_route_is_found_again():
    corner = Route(np.concatenate([east(0, 100), north(100, 100)[1:]]))

    assert corner.find(np.array([30.5, 2.0])) == (30.5, 2.0)
    way_m, off_m = corner.find(np.array([103.0, 40.0]))
    assert (way_m, off_m) == (140.0, 3.0)


def test_a_place_is_looked_for_near_where_it_was():
    """A route that comes back to where it was: which of its passes, tells the last one."""
    there_and_back = np.concatenate([east(0, 200), east(0, 200, 1.0)[::-1]])
    route = Route(there_and_back)

    assert route.find(np.array([50.0, 0.5]), 45.0)[0] == 50.0
    assert route.find(np.array([50.0, 0.5]), 350.0)[0] > 345.0


def test_points_beyond_the_end_are_its_end():
    route = Route(east(0, 10))

    np.testing.assert_allclose(
        route.at(np.array([2.5, 10.0, 99.0])), [[2.5, 0], [10, 0], [10, 0]]
    )
