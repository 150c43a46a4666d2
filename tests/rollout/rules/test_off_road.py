"""Who leaves the road: edges 3 m to either side of a lane along +x, by hand."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.population import Population
from infgen.rollout.rules.off_road import LANE_M, RoadEdgeTiles, find_off_road
from infgen.scene import AgentType, FeatureType
from tests.conftest import EDGE_ID, LANE_ID, make_map, make_scene
from tests.rollout.rules.test_collision import everyone, ways

CAR, WALKER, RIDER = AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST


def street(*more, lane_y_m=0.0):
    """A street with both of its edges, and more lines."""
    x = np.arange(-100.0, 101.0)
    lines = [
        (LANE_ID, FeatureType.LANE, 0, np.column_stack([x, 0 * x + lane_y_m])),
        (EDGE_ID, FeatureType.ROAD_EDGE, 0, np.column_stack([x, 0 * x - 3])),
        (EDGE_ID + 1, FeatureType.ROAD_EDGE, 0, np.column_stack([-x, 0 * x + 3])),
        *more,
    ]
    return scene_of(lines)


def scene_of(lines):
    path = np.zeros((1, 11, 3), dtype=np.float32)
    return make_scene(path, [CAR], road_map=make_map(lines))


def off_m(road_edge_tiles, *xy_m):
    return road_edge_tiles.off_m(np.array(xy_m, dtype=np.float32)).tolist()


@given(st.floats(-90, 90), st.floats(-40, 40))
def test_places_off_the_road_are_as_far_off_as_they_are(x_m, y_m):
    """The lane is elsewhere, so that only the edges decide."""
    road_edge_tiles = RoadEdgeTiles(street(lane_y_m=500.0))

    assert off_m(road_edge_tiles, (x_m, y_m)) == [pytest.approx(abs(y_m) - 3, abs=1e-4)]
    assert off_m(road_edge_tiles, (x_m, y_m), (x_m, y_m + 16)) == [
        pytest.approx(abs(y_m) - 3, abs=1e-4),
        pytest.approx(abs(y_m + 16) - 3, abs=1e-4),
    ]


def test_what_was_looked_at_is_not_looked_at_again():
    road_edge_tiles = RoadEdgeTiles(street())
    place = np.random.default_rng(0).uniform(-40, 40, (200, 2)).astype(np.float32)
    alone = [RoadEdgeTiles(street()).off_m(one[None])[0] for one in place[:9]]

    first, some, again = (
        road_edge_tiles.off_m(place),
        road_edge_tiles.off_m(place[:9]),
        road_edge_tiles.off_m(place),
    )

    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(some, first[:9])
    np.testing.assert_array_equal(alone, some)


def test_a_bridge_over_the_lane_does_not_take_the_road_away():
    """Its edge crosses at x = 0 with its own road on the side of -x."""
    y = np.arange(-20.0, 21.0)
    bridge = (EDGE_ID + 2, FeatureType.ROAD_EDGE, 0, np.column_stack([0 * y, y]))
    road_edge_tiles = RoadEdgeTiles(street(bridge))

    on_the_lane, beside_it, farther = off_m(
        road_edge_tiles, (0.5, 0.5), (0.5, 1.5), (0.5, 2.0)
    )

    assert on_the_lane <= 0
    assert beside_it == pytest.approx(1.5 - LANE_M, abs=1e-5)
    assert farther == pytest.approx(0.5, abs=1e-5)


def test_without_edges_everywhere_is_road():
    x = np.arange(-10.0, 11.0)
    lane = (LANE_ID, FeatureType.LANE, 0, np.column_stack([x, 0 * x]))

    assert off_m(RoadEdgeTiles(scene_of([lane])), (0, 50)) == [-np.inf]


def test_without_lanes_edges_decide():
    x = np.arange(-10.0, 11.0)
    edge = (EDGE_ID, FeatureType.ROAD_EDGE, 0, np.column_stack([x, 0 * x]))

    assert off_m(RoadEdgeTiles(scene_of([edge])), (0, -2), (0, 2)) == [2, -2]


def departs(y_m, heading_rad, metres, agent_type=CAR, moments=2):
    """A car 4 m long and 2 m wide at (0, y) goes straight on."""
    population = everyone((0, y_m, heading_rad), agent_type=agent_type)
    found = find_off_road(
        population,
        np.ones((1, 1), dtype=bool),
        ways(population, metres),
        np.array([[moments]]),
        [RoadEdgeTiles(street())],
        np.zeros(1, dtype=np.int64),
    )
    return found.item()


@pytest.mark.parametrize(
    ("y_m", "heading_rad", "metres", "found"),
    [
        (-1.9, 0.0, 10.0, False),  # Along the road, 0.1 m from its edge.
        (0.0, -np.pi / 2, 0.9, False),  # Straight to the edge, its nose 2 m ahead of it:
        (0.0, -np.pi / 2, 1.2, True),  # over it.
        (0.0, np.pi / 2, 1.2, True),
        (-2.5, 0.0, 10.0, False),  # Half a metre off already, but no farther.
        (-2.5, -0.1, 10.0, True),
        (-2.5, 0.5, 2.0, False),  # On its way back.
        (-6.0, -np.pi / 2, 5.0, False),  # In a drive.
    ],
)
def test_who_is_on_the_road_leaves_it(y_m, heading_rad, metres, found):
    assert departs(y_m, heading_rad, metres) is found


def test_nobody_is_looked_at_for_longer_than_asked():
    """Over the edge at the end of the way, but not at its middle, 0.6 of it."""
    assert departs(0.0, -np.pi / 2, 1.2, moments=2)
    assert not departs(0.0, -np.pi / 2, 1.2, moments=1)


@pytest.mark.parametrize("agent_type", [WALKER, RIDER])
def test_only_vehicles_are_kept(agent_type):
    assert not departs(0.0, -np.pi / 2, 5.0, agent_type)


def test_everyone_is_held_against_the_map_of_its_own_rollout_if_asked_about():
    one = everyone((0, 0, -np.pi / 2), (9, 0, 0))
    both = Population(
        **{f.name: np.concatenate([getattr(one, f.name)] * 2) for f in fields(one)}
    )
    way = np.concatenate([ways(one, 5.0, 5.0)] * 2)
    road_edge_tiles = [RoadEdgeTiles(street()), RoadEdgeTiles(scene_of([]))]
    which, moments = np.ones((2, 2), dtype=bool), np.full((2, 2), 2)

    def ask(which, scene):
        one_map = np.array(scene)
        return find_off_road(both, which, way, moments, road_edge_tiles, one_map).tolist()

    assert ask(which, [0, 0]) == [[True, False], [True, False]]
    assert ask(which, [1, 0]) == [[False, False], [True, False]]
    assert ask(~which, [0, 0]) == [[False, False], [False, False]]
