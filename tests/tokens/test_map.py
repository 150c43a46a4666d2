import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from infgen.scene import FeatureType, LaneType, RoadEdgeType, RoadLineType
from infgen.tokens.map import (
    PointType,
    PolylineType,
    cut_map_tokens,
    match_map_tokens,
    nearest_map_tokens,
)
from infgen.tokens.vocabulary import MapVocabulary

LANE = (FeatureType.LANE, LaneType.SURFACE_STREET)


def along_x(length_m, spacing_m=0.5):
    x = np.append(np.arange(0, length_m - 1e-9, spacing_m), length_m)
    return np.column_stack([x, np.zeros_like(x)])


@pytest.fixture(scope="session")
def pieces_of(build_map):
    """Pieces of lanes, given as arrays of points."""

    def build(*lines):
        named = [(number + 1, *LANE, points) for number, points in enumerate(lines)]
        return cut_map_tokens(build_map(named))

    return build


def test_a_straight_line_of_twenty_metres_gives_four_pieces(pieces_of):
    pieces = pieces_of(along_x(20.0))
    np.testing.assert_allclose(
        pieces.pose, [[0, 0, 0], [5, 0, 0], [10, 0, 0], [15, 0, 0]], atol=1e-5
    )
    np.testing.assert_allclose(pieces.length_m, 5, atol=1e-5)
    np.testing.assert_allclose(pieces.sample_m[2], [[0, 0], [2.5, 0], [5, 0]], atol=1e-5)
    np.testing.assert_array_equal(pieces.polyline, 0)
    np.testing.assert_array_equal(pieces.feature_id, 1)


@pytest.mark.parametrize(
    ("length_m", "lengths_m"),
    [
        (0.4, []),  # one interval, two points: too short
        (0.5, []),
        (0.6, [0.6]),  # two intervals, three points
        (3.0, [3.0]),
        (4.6, [4.6]),  # ten intervals: as good as whole
        (5.0, [5.0]),
        (6.0, [5.0]),  # two intervals more are lost
        (6.1, [5.0, 1.1]),  # three are not
        (9.8, [5.0, 4.8]),
        (12.0, [5.0, 5.0, 2.0]),
    ],
)
def test_what_is_left_of_a_line_is_a_shorter_piece_or_lost(pieces_of, length_m, lengths_m):
    pieces = pieces_of(along_x(length_m))
    np.testing.assert_allclose(pieces.length_m, lengths_m, atol=1e-5)
    for length, sample in zip(lengths_m, pieces.sample_m, strict=True):
        np.testing.assert_allclose(sample[:, 0], [0, length / 2, length], atol=1e-5)


def test_how_densely_a_line_is_drawn_does_not_matter(pieces_of):
    one, two = pieces_of(along_x(23.0, 0.5)), pieces_of(along_x(23.0, 2.3))
    np.testing.assert_allclose(one.pose, two.pose, atol=1e-5)
    np.testing.assert_allclose(one.curve_m, two.curve_m, atol=1e-5)


def test_a_curve_is_cut_by_its_arc_length(pieces_of):
    angle = np.linspace(0, np.pi / 2, 400)
    circle = 20 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    pieces = pieces_of(circle)
    assert pieces.num_map_tokens == 7  # 31.4 m: six whole ones and 1.4 m
    np.testing.assert_allclose(pieces.pose[:, 2], 0.25 * np.arange(7) + 0.0125, atol=0.01)
    bent = np.arctan2(*(pieces.curve_m[0, -1] - pieces.curve_m[0, -2])[::-1])
    assert bent == pytest.approx(0.225, abs=0.01)


def test_lines_are_broken_where_points_are_far_apart(pieces_of):
    gap = np.concatenate([along_x(6.0), along_x(6.0) + np.array([17.0, 0.0])])
    pieces = pieces_of(gap)
    np.testing.assert_allclose(pieces.pose[:, 0], [0, 17], atol=1e-5)
    np.testing.assert_array_equal(pieces.polyline, [0, 0])


def test_lines_are_broken_at_a_stray_chord_but_not_at_a_straight_one(pieces_of):
    bend = np.concatenate([along_x(6.0), along_x(6.0) + np.array([8.0, 4.0])])
    straight = np.concatenate([along_x(6.0), along_x(6.0) + np.array([10.0, 0.0])])
    assert pieces_of(bend).num_map_tokens == 2
    np.testing.assert_allclose(pieces_of(straight).pose[:, 0], [0, 5, 10], atol=1e-5)


def test_the_end_of_one_line_says_nothing_of_the_next(pieces_of):
    pieces = pieces_of(
        along_x(7.0), along_x(12.0) + np.array([3.0, 50.0]), along_x(5.0) - 90
    )
    np.testing.assert_array_equal(pieces.polyline, [0, 0, 1, 1, 1, 2])
    np.testing.assert_array_equal(pieces.feature_id, [1, 1, 2, 2, 2, 3])
    np.testing.assert_allclose(pieces.pose[2], [3, 50, 0], atol=1e-5)


def test_heights_are_those_of_the_first_points(pieces_of):
    ramp = np.column_stack([along_x(10.0), 0.1 * along_x(10.0)[:, 0]])
    np.testing.assert_allclose(pieces_of(ramp).z_m, [0, 0.5], atol=1e-5)


def test_repeated_points_and_lines_of_one_point_are_harmless(pieces_of):
    double = np.repeat(along_x(10.0), 2, axis=0)
    pieces = pieces_of(np.zeros((1, 2)), double, np.zeros((4, 2)))
    np.testing.assert_allclose(pieces.pose, [[0, 0, 0], [5, 0, 0]], atol=1e-5)
    assert np.isfinite(pieces.curve_m).all()


def test_an_empty_map_has_no_pieces(pieces_of, bent_roads):
    pieces = pieces_of()
    assert pieces.num_map_tokens == 0
    assert match_map_tokens(pieces, bent_roads).shape == (0,)


@pytest.mark.parametrize(
    ("feature", "feature_subtype", "polyline_type", "point_type"),
    [
        (FeatureType.LANE, LaneType.FREEWAY, PolylineType.LANE, PointType.FREEWAY),
        (
            FeatureType.LANE,
            LaneType.SURFACE_STREET,
            PolylineType.LANE,
            PointType.SURFACE_STREET,
        ),
        (FeatureType.LANE, LaneType.BIKE_LANE, PolylineType.LANE, PointType.BIKE_LANE),
        (FeatureType.LANE, LaneType.UNDEFINED, PolylineType.LANE, PointType.SURFACE_STREET),
        (
            FeatureType.ROAD_LINE,
            RoadLineType.BROKEN_SINGLE_WHITE,
            PolylineType.ROAD_LINE,
            PointType.BROKEN_LINE,
        ),
        (
            FeatureType.ROAD_LINE,
            RoadLineType.SOLID_SINGLE_YELLOW,
            PolylineType.ROAD_LINE,
            PointType.SOLID_LINE,
        ),
        (
            FeatureType.ROAD_LINE,
            RoadLineType.PASSING_DOUBLE_YELLOW,
            PolylineType.ROAD_LINE,
            PointType.DOUBLE_LINE,
        ),
        (
            FeatureType.ROAD_EDGE,
            RoadEdgeType.BOUNDARY,
            PolylineType.ROAD_EDGE,
            PointType.BOUNDARY,
        ),
        (
            FeatureType.ROAD_EDGE,
            RoadEdgeType.MEDIAN,
            PolylineType.ROAD_EDGE,
            PointType.MEDIAN,
        ),
        (FeatureType.ROAD_EDGE, 9, PolylineType.ROAD_EDGE, PointType.MEDIAN),
    ],
)
def test_lines_are_typed(build_map, feature, feature_subtype, polyline_type, point_type):
    pieces = cut_map_tokens(build_map([(7, feature, feature_subtype, along_x(5.0))]))
    np.testing.assert_array_equal(pieces.polyline_type, polyline_type)
    np.testing.assert_array_equal(pieces.point_type, point_type)


def test_there_are_ten_point_kinds_and_four_line_kinds():
    assert (len(PointType), len(PolylineType)) == (10, 4)


def test_a_lane_with_a_stop_sign_has_its_own_kind(build_map):
    lanes = [(7, *LANE, along_x(5.0)), (8, *LANE, along_x(5.0) + 9)]
    road_map = dataclasses.replace(
        build_map(lanes), sign_id=np.array([70]), sign_lane_id=np.array([8])
    )
    assert cut_map_tokens(road_map).point_type.tolist() == [
        PointType.SURFACE_STREET,
        PointType.STOP_CONTROLLED,
    ]


def test_stop_signs_and_unknown_features_are_no_lines(build_map):
    features = [(5, FeatureType.STOP_SIGN, 0, np.zeros((1, 2))), (6, 0, 0, along_x(9.0))]
    assert cut_map_tokens(build_map(features)).num_map_tokens == 0


ZEBRA = np.array([[0, 0], [12, 0], [12, 3], [0, 3]])


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("closed", [False, True])
def test_a_crosswalk_is_drawn_as_its_long_sides_there_and_back(build_map, first, closed):
    outline = np.roll(ZEBRA, first, axis=0)
    outline = np.vstack([outline, outline[:1]]) if closed else outline
    pieces = cut_map_tokens(build_map([(4, FeatureType.CROSSWALK, 0, outline)]))
    # 12 m: two whole pieces and one of two metres, four times over; no break at 12 m.
    np.testing.assert_array_equal(pieces.polyline, np.repeat(np.arange(4), 3))
    np.testing.assert_array_equal(pieces.point_type, PointType.CROSSING)
    np.testing.assert_array_equal(pieces.polyline_type, PolylineType.AREA)
    starts = {tuple(np.round(pose, 3) + 0.0) for pose in pieces.pose[::3]}
    pi = np.round(np.pi, 3)
    assert {(x, y, abs(h)) for x, y, h in starts} == {
        (0, 0, 0),
        (12, 0, np.float32(pi)),
        (12, 3, np.float32(pi)),
        (0, 3, 0),
    }


def test_the_sides_of_a_bent_speed_bump_follow_the_bend(build_map):
    inner = np.array([[0, 0], [4, 1], [8, 3]])
    outer = inner + np.array([-0.3, 1.0])
    outline = np.vstack([inner, outer[::-1]])
    pieces = cut_map_tokens(build_map([(4, FeatureType.SPEED_BUMP, 0, outline)]))
    length = np.hypot(4, 1) + np.hypot(4, 2)
    totals = np.bincount(pieces.polyline, weights=pieces.length_m)
    np.testing.assert_allclose(totals, [length] * 4, atol=1e-3)
    assert {tuple(np.round(p[:2], 1) + 0.0) for p in pieces.pose[::2]} == {
        tuple(np.float32(corner))
        for corner in [(0, 0), (8, 3), (-0.3, 1), (np.float32(7.7), 4)]
    }


def test_areas_of_any_number_of_corners_are_drawn(build_map):
    triangle = np.array([[0, 0], [9, 0], [0, 2]])
    pentagon = np.array([[0, 0], [9, 0], [10, 2], [9, 4], [0, 4]]) + 50
    point = np.zeros((1, 2))
    road_map = build_map(
        [
            (1, FeatureType.DRIVEWAY, 0, triangle),
            (2, FeatureType.DRIVEWAY, 0, pentagon),
            (3, FeatureType.DRIVEWAY, 0, point),
        ]
    )
    pieces = cut_map_tokens(road_map)
    assert set(pieces.feature_id) == {1, 2}
    assert np.isfinite(pieces.pose).all()


def loop_pieces(points):
    """The rules of SPEC 1.3 for one line, point by point."""
    chains, chain = [], [points[0]]
    headings = [np.arctan2(*(b - a)[::-1]) for a, b in itertools.pairwise(points)]

    def bent(i, j):
        turn = (headings[i] - headings[j] + np.pi) % (2 * np.pi) - np.pi
        return abs(turn) > 0.1

    for i in range(len(points) - 1):
        gap = np.linalg.norm(points[i + 1] - points[i])
        stray = (i > 0 and bent(i, i - 1)) or (i + 1 < len(headings) and bent(i, i + 1))
        if gap > 10 or (gap > 3 and stray):
            chains.append(chain)
            chain = []
        chain.append(points[i + 1])
    chains.append(chain)

    found = []
    for chain in chains:
        gaps = [np.linalg.norm(b - a) for a, b in itertools.pairwise(chain)]
        arc = np.concatenate([[0], np.cumsum(gaps)])
        xy = np.array(chain)
        n = 1
        while 0.5 * n < arc[-1] - 1e-6:
            n += 1
        n = n + 1 if arc[-1] > 1e-6 else 1  # points at 0, 0.5, ... and the end
        full = (n - 1) // 10
        rest = (n - 1) % 10 if full else n
        windows = [(5.0 * k, min(5.0 * k + 5, arc[-1])) for k in range(full)]
        if rest >= 3:
            windows.append((5.0 * full, arc[-1]))
        for start, end in windows:
            at = np.linspace(start, end, 11)
            found.append(
                np.column_stack(
                    [np.interp(at, arc, xy[:, 0]), np.interp(at, arc, xy[:, 1])]
                )
            )
    return found


@settings(max_examples=150)
@given(st.integers(0, 2**32), st.integers(2, 60), st.sampled_from([0.5, 1.3, 4.0, 9.0]))
@example(0, 2, 4.0)
def test_pieces_are_those_of_the_plain_loop(pieces_of, seed, many, spacing_m):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.08, many)) + rng.uniform(-3, 3)
    step = rng.uniform(0.2, 1.3, many) * spacing_m
    points = np.cumsum(
        step[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), 0
    )
    points = points.astype(np.float32).astype(float)
    pieces, expected = pieces_of(points), loop_pieces(points)
    assert pieces.num_map_tokens == len(expected)
    for pose, curve, wanted in zip(pieces.pose, pieces.curve_m, expected, strict=True):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        world = curve @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
        np.testing.assert_allclose(world, wanted, atol=2e-3)
        assert pose[2] == pytest.approx(
            np.arctan2(*(wanted[1] - wanted[0])[::-1]), abs=2e-3
        )


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.floats(-3, 3), st.floats(-200, 200))
def test_tokens_do_not_change_when_the_map_is_turned_and_moved(
    pieces_of, bent_roads, seed, turn, far
):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.05, 80))
    points = np.cumsum(0.5 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    cos, sin = np.cos(turn), np.sin(turn)
    moved = points @ np.array([[cos, sin], [-sin, cos]]) + far
    one, two = pieces_of(points), pieces_of(moved)
    np.testing.assert_allclose(one.curve_m, two.curve_m, atol=2e-3)
    gaps = ((one.sample_m[:, None] - bent_roads.sample_m) ** 2).sum(axis=(2, 3))
    near = np.partition(gaps, 1, axis=1)
    clear = near[:, 1] - near[:, 0] > 0.02  # not between two shapes
    same = match_map_tokens(one, bent_roads) == match_map_tokens(two, bent_roads)
    assert same[clear].all()


def test_a_shape_of_the_codebook_is_matched_to_itself():
    rng = np.random.default_rng(0)
    turn = rng.normal(0, 0.8, (1000, 1)) * np.arange(10) / 9
    length = rng.uniform(1, 5, (1000, 1, 1))
    steps = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * length / 10
    curve = np.concatenate([np.zeros((1000, 1, 2)), np.cumsum(steps, axis=1)], axis=1)
    vocabulary = MapVocabulary(curve.astype(np.float32), np.ones(1000, bool))
    np.testing.assert_array_equal(
        nearest_map_tokens(vocabulary.curve_m, vocabulary), np.arange(1000)
    )


@given(st.integers(0, 2**32))
@settings(max_examples=30)
def test_the_match_has_the_least_sum_of_squared_gaps(bent_roads, seed):
    rng = np.random.default_rng(seed)
    wanted = rng.normal(0, 2, (700, 11, 2)).astype(np.float32)
    wanted -= wanted[:, :1]
    gaps = wanted[:, None, [0, 5, 10]].astype(float) - bent_roads.sample_m
    squares = (gaps**2).sum(axis=(2, 3))
    chosen = nearest_map_tokens(wanted, bent_roads)
    least = squares.min(axis=1)
    np.testing.assert_allclose(squares[np.arange(700), chosen], least, rtol=1e-4, atol=1e-4)
