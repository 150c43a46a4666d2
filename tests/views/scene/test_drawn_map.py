import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.scene import FeatureType, LaneType, RoadEdgeType, RoadLineType, SignalState
from infgen.tokens.scene_tokens import SignalClass
from infgen.views.scene.drawn_map import (
    RoadLook,
    draw_map,
    find_lights,
    look_of,
    thin,
    zebra,
)

POINTS = arrays(np.float32, (12, 2), elements=st.floats(-50, 50, width=32))


def away_m(points, line):
    """Distance of each point from the nearest of many places along a line."""
    share = np.linspace(0, 1, 1001)[:, None, None]
    places = (line[:-1] + share * (line[1:] - line[:-1])).reshape(-1, 2)
    return np.linalg.norm(points[:, None] - places, axis=-1).min(axis=1)


def test_a_straight_line_keeps_its_ends_only():
    line = np.column_stack([np.arange(50.0), 2 * np.arange(50.0)]).astype(np.float32)

    np.testing.assert_array_equal(thin(line, 0.01), line[[0, -1]])


def test_a_corner_stays():
    line = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2]], np.float32)

    np.testing.assert_array_equal(thin(line, 0.01), line[[0, 2, 4]])


@settings(max_examples=40)
@given(POINTS, st.sampled_from([0.1, 1.0, 10.0]))
def test_no_point_is_farther_from_the_thinned_line_than_the_tolerance(line, tolerance_m):
    kept = thin(line, tolerance_m)

    # The places are up to 7 cm from what lies between them: pieces are up to 141 m long.
    assert away_m(line, kept).max() <= tolerance_m + 0.08


@pytest.mark.parametrize("count", [0, 1, 2])
def test_very_short_lines_stay_as_they_are(count):
    line = np.arange(2.0 * count).reshape(count, 2).astype(np.float32)

    np.testing.assert_array_equal(thin(line, 5.0), line)


def test_a_crosswalk_of_twelve_metres_has_ten_stripes_along_the_road():
    stripes = zebra(np.array([[0, 0], [3, 0], [3, 12], [0, 12]], np.float32))

    assert len(stripes) == 10
    for stripe in stripes:
        np.testing.assert_allclose(np.ptp(stripe, axis=0), [3.0, 0.6], atol=1e-5)


def test_it_does_not_matter_at_which_corner_a_crosswalk_begins_or_whether_it_is_closed():
    outline = np.array([[0, 0], [3, 0], [3, 12], [0, 12]], np.float32)
    turned = np.roll(outline, 1, axis=0)
    closed = np.concatenate([outline, outline[:1]])

    for other in (turned, closed):
        middles = sorted(stripe.mean(axis=0).tolist() for stripe in zebra(other))
        expected = sorted(stripe.mean(axis=0).tolist() for stripe in zebra(outline))
        np.testing.assert_allclose(middles, expected, atol=1e-5)


def test_a_crosswalk_with_more_corners_stays_whole():
    outline = np.array([[0, 0], [3, 0], [4, 5], [3, 12], [0, 12]], np.float32)

    (only,) = zebra(outline)
    np.testing.assert_array_equal(only, outline)


@pytest.mark.parametrize(
    ("agent_type", "type_", "look"),
    [
        (FeatureType.LANE, LaneType.UNDEFINED, RoadLook.LANE),
        (FeatureType.LANE, LaneType.BIKE_LANE, RoadLook.BIKE_LANE),
        (FeatureType.ROAD_LINE, RoadLineType.UNKNOWN, RoadLook.WHITE_BROKEN),
        (FeatureType.ROAD_LINE, RoadLineType.PASSING_DOUBLE_YELLOW, RoadLook.YELLOW_DOUBLE),
        (FeatureType.ROAD_EDGE, RoadEdgeType.MEDIAN, RoadLook.MEDIAN),
        (FeatureType.ROAD_EDGE, RoadEdgeType.UNKNOWN, RoadLook.EDGE),
        (FeatureType.STOP_SIGN, 0, RoadLook.STOP_SIGN),
    ],
)
def test_features_look_like_what_they_are(agent_type, type_, look):
    assert look_of(agent_type, type_) is look


def test_every_kind_and_type_has_a_look():
    types = {
        FeatureType.LANE: LaneType,
        FeatureType.ROAD_LINE: RoadLineType,
        FeatureType.ROAD_EDGE: RoadEdgeType,
    }
    for agent_type in FeatureType:
        for type_ in types.get(agent_type, [0]):
            assert look_of(agent_type, type_) is not None


def test_lines_lie_from_the_bottom_up(build_map):
    bend = np.array([[0, 0], [5, 0], [5, 5]])
    drawn = draw_map(
        build_map(
            [
                (7, FeatureType.STOP_SIGN, 0, np.array([[1.0, 2.0]])),
                (8, FeatureType.ROAD_EDGE, 1, bend),
                (9, FeatureType.LANE, 2, bend + 1),
            ]
        )
    )

    assert drawn.look.tolist() == [RoadLook.LANE, RoadLook.EDGE, RoadLook.STOP_SIGN]
    np.testing.assert_array_equal(drawn.line(0), bend + 1)
    np.testing.assert_array_equal(drawn.line(2), [[1, 2]])


def test_a_map_without_features_is_empty(build_map):
    assert draw_map(build_map([])).offsets.tolist() == [0]


def test_a_light_stands_across_its_lane_and_changes(drive, build_signals):
    states = [(step, 1, SignalState.STOP) for step in range(5)]
    states += [(step, 1, SignalState.ARROW_GO) for step in range(5, 91)]

    lights = find_lights(drive(signals=build_signals(states)))

    assert lights.heading_rad.tolist() == [0.0]
    assert lights.state[0, 4] == SignalClass.STOP
    assert lights.state[0, 5] == SignalClass.GO


def test_a_light_of_a_lane_that_is_not_on_the_map_is_drawn_all_the_same(
    drive, build_signals
):
    lights = find_lights(drive(signals=build_signals([(0, 999, SignalState.STOP)])))

    assert lights.heading_rad.tolist() == [0.0]
    assert lights.state[0, 0] == SignalClass.STOP
    assert lights.state[0, 1] == SignalClass.NO_SIGNAL
