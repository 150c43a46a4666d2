"""Inserted agents are judged by where road edges and lanes are at their places."""

import math

import pytest
import torch

from infgen.model.features.polyline_segments import lane_centres, road_edges
from infgen.model.insertion.placement_features import (
    ANGLE_STEPS,
    OVER_REACH_M,
    OVER_STEP_M,
    PlacementFeatures,
    Places,
)
from infgen.tokens.grid import make_grid
from infgen.tokens.map import PolylineType

EAST = 0.0
NORTH = math.pi / 2
WIDTH = 6


@pytest.fixture
def grid(grid_settings):
    return make_grid(grid_settings)


@pytest.fixture
def placement(grid):
    torch.manual_seed(0)
    return PlacementFeatures(WIDTH, grid)


def at(*pose):
    return torch.tensor([pose], dtype=torch.float32), torch.zeros(1, dtype=torch.int64)


def test_offset_bins_are_as_far_over_an_edge_as_to_its_right(placement, grid, lines):
    edge = road_edges(lines(PolylineType.ROAD_EDGE, (-2.5, -1.0, EAST)))

    # A query that faces east: ahead of it is along the edge, its right is over it.
    over_m = placement.over_m(*at(0, 0, EAST), edge)

    right_m = torch.from_numpy(grid.offset_m[:, 0])
    torch.testing.assert_close(over_m[0], right_m - 1.0, atol=1e-5, rtol=0)


def test_turning_query_and_edge_changes_nothing(placement, lines):
    edge = lines(PolylineType.ROAD_EDGE, (-2.5, -1.0, EAST))
    turned = lines(PolylineType.ROAD_EDGE, (1.0, -2.5, NORTH))

    one = placement.over_m(*at(0, 0, EAST), road_edges(edge))
    other = placement.over_m(*at(0, 0, NORTH), road_edges(turned))

    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_headings_are_turned_from_the_lane_nearest_in_angle(placement, grid, lines):
    both = lane_centres(lines(PolylineType.LANE, (-2.5, 0.5, EAST), (0.5, -2.5, NORTH)))

    turned_rad = placement.turned_rad(*at(0, 0, EAST), both)[0]

    heading_rad = torch.from_numpy(grid.heading_centre_rad)
    to_east, to_north = (
        torch.atan2((heading_rad - x).sin(), (heading_rad - x).cos()).abs()
        for x in (EAST, NORTH)
    )
    expected = torch.minimum(to_east, to_north)
    torch.testing.assert_close(turned_rad, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("kind", "left_m"),
    [(PolylineType.LANE, 2.1), (PolylineType.ROAD_LINE, 0.0), (PolylineType.LANE, 200.0)],
    ids=["beside", "no lane", "far away"],
)
def test_without_a_lane_there_no_heading_is_judged(placement, kind, left_m, lines):
    found = lane_centres(lines(kind, (-2.5, left_m, EAST)))

    turned_rad = placement.turned_rad(*at(0, 0, EAST), found)

    assert turned_rad.isinf().all()


def test_maps_without_lanes_or_edges(placement, grid, lines):
    none = lines(PolylineType.AREA)

    over_m = placement.over_m(*at(0, 0, EAST), road_edges(none))
    turned_rad = placement.turned_rad(*at(0, 0, EAST), lane_centres(none))

    assert over_m.shape == (1, len(grid.offset_m))
    assert over_m.isneginf().all()
    assert turned_rad.isinf().all()


def test_what_is_said_is_interpolated(placement, lines):
    """Knots that say where they are give back distances and angles."""
    knots = torch.arange(placement.over_steps + 1) * OVER_STEP_M - OVER_REACH_M
    angles = torch.arange(ANGLE_STEPS + 1) * (math.pi / ANGLE_STEPS)
    for part, values in ((placement.over, knots), (placement.angle, angles)):
        torch.nn.init.zeros_(part.weight)
        part.bias.data = values.float()
    x = torch.randn(1, WIDTH)
    edges = road_edges(lines(PolylineType.ROAD_EDGE, (-2.5, -1.0, EAST)))
    places = Places(
        *at(0, 0, EAST), edges, lane_centres(lines(PolylineType.LANE, (0, 0, NORTH)))
    )

    over_m = placement.offsets(x, places)
    turned_rad = placement.headings(x, places, torch.tensor([[-2.0, 1.0]]))

    expected_m = placement.over_m(places.pose, places.scene, edges)
    expected_rad = placement.turned_rad(*at(1, 2, EAST), places.lanes)
    torch.testing.assert_close(over_m, expected_m, atol=1e-3, rtol=0)
    torch.testing.assert_close(turned_rad, expected_rad, atol=1e-3, rtol=0)
