"""Road edges, lines and signs of a crossing of known measures, and its map."""

import numpy as np
import pytest

from infgen.scene import FeatureType, LaneType, LinkType, RoadEdgeType, RoadLineType
from infgen.sources.towns.streets.markings import (
    draw_bumps,
    draw_crosswalks,
    draw_lines,
    draw_signs,
)
from infgen.sources.towns.streets.network import Use
from infgen.sources.towns.streets.road_edges import draw_road_edges, reverse_of
from infgen.sources.towns.streets.road_map import Furniture, draw_map, keep_features
from infgen.sources.towns.streets.street_types import Rank, Street

BROAD = Street(Rank.ARTERIAL, 2, 3.5, 45.0, 1.0, 0.0, 0.0, 2.0, True, 0.5)
NARROW = Street(Rank.LOCAL, 1, 3.0, 25.0, 0.0, 0.0, 2.2, 2.0, True, 0.5)


@pytest.fixture(scope="module")
def streets():
    return {
        f"e{link}{way}": street
        for link, street in enumerate((BROAD, NARROW, BROAD, NARROW))
        for way in "fb"
    }


@pytest.fixture(scope="module")
def town_map(crossing, streets):
    furniture = Furniture(
        lines=list(draw_lines(crossing, streets)),
        road_edges=list(draw_road_edges(crossing)),
        crosswalks=draw_crosswalks(crossing, np.random.default_rng(0)),
        driveways=[],
        bumps=draw_bumps(crossing, streets, np.random.default_rng(0)),
        signs=list(draw_signs(crossing)),
    )
    return draw_map(crossing, furniture)


def on_left(line_m, point_m):
    """Whether a point is on the left of the nearest segment of a line."""
    nearest = np.linalg.norm(line_m[:-1] - point_m, axis=1).argmin()
    way_m, to_m = line_m[nearest + 1] - line_m[nearest], point_m - line_m[nearest]
    return way_m[0] * to_m[1] - way_m[1] * to_m[0] > 0


def test_kerbs_have_the_road_on_their_left(crossing):
    road_edges = [
        kerb for kerb in draw_road_edges(crossing) if kerb.kind is RoadEdgeType.BOUNDARY
    ]

    assert len(road_edges) == 8  # Along every arm inwards, and along every arm outwards.
    for kerb in road_edges:
        nearest = min(
            (
                lane.xy_m[0] + 0.5 * (lane.xy_m[-1] - lane.xy_m[0])
                for lane in crossing.lanes.values()
            ),
            key=lambda middle_m: np.linalg.norm(kerb.xy_m - middle_m, axis=1).min(),
        )
        assert on_left(kerb.xy_m, nearest)


def test_a_kerb_comes_in_rounds_the_corner_and_goes_on_in_the_next_arm(crossing):
    road_edges = [kerb.xy_m for kerb in draw_road_edges(crossing)]
    coming = next(xy_m for xy_m in road_edges if np.allclose(xy_m[0], (5.2, -100.0)))

    np.testing.assert_allclose(coming[-1], (9.5, -8.3), atol=0.01)
    assert any(np.allclose(xy_m[0], coming[-1], atol=0.01) for xy_m in road_edges)
    turned_rad = np.abs(np.diff(np.unwrap(np.arctan2(*np.diff(coming, axis=0).T[::-1]))))
    assert turned_rad.max() < 0.5


def test_an_island_is_closed_and_lies_between_the_directions(crossing):
    islands = [
        kerb.xy_m for kerb in draw_road_edges(crossing) if kerb.kind is RoadEdgeType.MEDIAN
    ]

    assert len(islands) == 2
    for xy_m in islands:
        np.testing.assert_allclose(xy_m[0], xy_m[-1])
        np.testing.assert_allclose(np.abs(xy_m[:, 1]), 1.0, atol=1e-6)
        assert on_left(xy_m, np.array([50.0 * np.sign(xy_m[0, 0]), 4.0]))


def test_lines_are_yellow_between_directions_and_white_between_lanes(crossing, streets):
    kinds = [line.kind for line in draw_lines(crossing, streets)]

    # Along the island on both sides; in the narrow streets between the directions.
    assert kinds.count(RoadLineType.SOLID_SINGLE_YELLOW) == 4
    assert kinds.count(RoadLineType.BROKEN_SINGLE_YELLOW) == 2
    assert kinds.count(RoadLineType.BROKEN_SINGLE_WHITE) == 4
    assert len(kinds) == 10


def test_all_crossings_at_a_light_are_painted(crossing):
    outlines = draw_crosswalks(crossing, np.random.default_rng(0))

    assert len(outlines) == 4
    for outline_m in outlines:
        sides_m = np.linalg.norm(np.diff(outline_m, axis=0), axis=1)
        np.testing.assert_allclose(sides_m[0], sides_m[2], rtol=1e-6)


def test_bumps_lie_across_the_lanes_of_slow_streets(crossing, streets):
    drawn = [
        draw_bumps(crossing, streets, np.random.default_rng(seed)) for seed in range(20)
    ]

    assert 0.2 < np.mean([len(bumps) for bumps in drawn]) / 2 < 0.6
    for outline_m in (outline_m for bumps in drawn for outline_m in bumps):
        # Two lanes of 3 m, across the street that runs north; about 2 m deep.
        np.testing.assert_allclose(np.abs(outline_m[:, 0]), 3.0, atol=1e-6)
        assert 1.5 < np.ptp(outline_m[:, 1]) < 2.5


def test_nobody_stops_at_a_sign_where_there_is_a_light(crossing):
    assert not list(draw_signs(crossing))


def test_reverse_of_a_street_is_its_other_direction():
    assert (reverse_of("e12f"), reverse_of("e12b")) == ("e12b", "e12f")


def test_the_map_has_every_lane_and_way_across(crossing, town_map):
    road_map, ids = town_map
    lanes = road_map.rows(FeatureType.LANE)

    assert len(lanes) == len(crossing.lanes) + len(crossing.connectors) == 12 + 14
    assert set(road_map.feature_subtype[lanes]) == {LaneType.SURFACE_STREET}
    limits_mph = {road_map.speed_limit_mph[ids[f"e{link}f_2"] - 1] for link in (0, 1)}
    assert limits_mph == {45.0, 25.0}


def test_exits_begin_where_a_lane_ends_and_are_entries_of_each_other(town_map):
    road_map, _ = town_map
    exits = road_map.link_type == LinkType.EXIT
    pairs = list(
        zip(road_map.link_lane_id[exits], road_map.link_other_id[exits], strict=True)
    )
    back = zip(road_map.link_other_id[~exits], road_map.link_lane_id[~exits], strict=True)

    assert sorted(pairs) == sorted(back)
    for lane, other in pairs:
        before, after = (road_map.points(int(row) - 1) for row in (lane, other))
        np.testing.assert_allclose(before[-1], after[0], atol=0.02)


def test_lanes_side_by_side_know_each_other_and_the_line_between(town_map):
    road_map, ids = town_map
    right, left = ids["e0f_2"], ids["e0f_3"]
    rows = np.flatnonzero(road_map.neighbour_lane_id == right)

    assert road_map.neighbour_other_id[rows].tolist() == [left]
    between = np.flatnonzero(np.isin(road_map.boundary_neighbour, rows))
    assert road_map.boundary_type[between].tolist() == [RoadLineType.BROKEN_SINGLE_WHITE]


def test_features_that_are_kept_keep_the_relations_among_them_only(crossing, town_map):
    road_map, ids = town_map
    east = road_map.feature_id == ids["e0f_2"]
    east |= road_map.feature_id == ids["e0f_3"]

    kept = keep_features(road_map, east)

    assert kept.num_features == 2
    np.testing.assert_array_equal(kept.points(1), road_map.points(ids["e0f_3"] - 1))
    assert len(kept.neighbour_lane_id) == 2
    assert not len(kept.link_lane_id)
    assert not len(kept.boundary_lane_id)  # The lines are not kept.


def test_all_features_kept_is_the_whole_map(town_map):
    road_map, _ = town_map
    kept = keep_features(road_map, np.ones(road_map.num_features, bool))

    for name in ("xyz_m", "link_other_id", "boundary_neighbour", "neighbour_span"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(road_map, name))


def test_parking_is_no_lane(crossing):
    assert all(lane.use is not Use.NO_USE for lane in crossing.lanes.values())
