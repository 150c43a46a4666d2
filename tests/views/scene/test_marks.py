from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from infgen.scene import AgentType, FeatureType, RoadLineType, SignalState
from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.drawn_map import draw_map, find_lights
from infgen.views.scene.map_marks import dashes, light_marks, map_marks, within
from infgen.views.scene.marks import View
from infgen.views.scene.shapes import shape_of
from infgen.views.scene.style import AGENTS, LIGHT, LIGHTS
from infgen.views.scene.view import all_marks, view_of
from infgen.views.scene.view_model import make_view_model, show_log, show_rollout
from tests.exports.replays import replay, with_newcomer

VIEW = View((0.0, 0.0), 10.0, 400.0, 200.0)


def crowd_marks(showing, time=10.0, view=VIEW):
    return list(AgentMarks(showing).marks(10, time, view, LIGHT))


def filled(marks, colour):
    return [mark for mark in marks if mark.fill == colour]


def test_a_view_has_its_centre_in_the_middle_and_north_up():
    view = View((5.0, 7.0), 10.0, 400.0, 200.0)

    points = view.to_px(np.array([[5.0, 7.0], [6.0, 8.0]]))

    np.testing.assert_allclose(points, [[200, 100], [210, 90]])


def test_the_view_shows_fifty_two_metres_around_the_ego(drive):
    view = view_of(show_log(drive(speed_mps=10.0)), 20.0, 520.0, 1000.0)

    assert view.scale == 5.0
    assert view.centre_m == pytest.approx((20.0, 0.0))


@pytest.mark.parametrize("agent_type", AgentType)
def test_a_shape_fills_its_box_and_points_ahead(agent_type):
    body = shape_of(agent_type, 4.0, 2.0).body

    wide = (
        4.0 if agent_type == AgentType.PEDESTRIAN else 2.0
    )  # A disc, drawn with 16 corners.
    assert np.ptp(body[:, 1]) == pytest.approx(wide, rel=0.02)
    assert body[:, 0].max() >= 2.0 - 1e-9
    assert abs(body[body[:, 0].argmax(), 1]) <= 1.0


def test_a_car_is_as_long_and_wide_as_its_box_and_its_windscreen_is_ahead():
    shape = shape_of(AgentType.VEHICLE, 4.6, 2.0)

    np.testing.assert_allclose(np.ptp(shape.body, axis=0), [4.6, 2.0])
    assert 0 < shape.mark[:, 0].min() < shape.mark[:, 0].max() < 2.3
    assert shape.dot[0] < 0


def test_an_agent_that_heads_north_points_up(drive):
    (body,) = filled(crowd_marks(show_log(drive(speed_mps=0.0))), LIGHT.ego)[1:]
    (north,) = filled(
        crowd_marks(show_log(drive(speed_mps=0.0, heading_rad=np.pi / 2))), LIGHT.ego
    )[1:]

    np.testing.assert_allclose(np.ptp(body.points_px, axis=0), [48, 20], atol=1e-4)
    np.testing.assert_allclose(np.ptp(north.points_px, axis=0), [20, 48], atol=1e-4)


def test_the_ego_wears_a_ring_and_who_came_later_a_dot(crossing):
    view = View((0.0, 0.0), 2.0, 400.0, 400.0)
    shown = show_rollout(with_newcomer(replay(crossing()), 40))

    before, after = crowd_marks(shown, 40.0, view), crowd_marks(shown, 50.0, view)

    for marks in (before, after):
        rings = [mark for mark in filled(marks, LIGHT.ego) if mark.alpha < 1]
        assert [ring.alpha for ring in rings] == [AGENTS.halo_alpha]
    assert not filled(before, LIGHT.inserted)
    assert len(filled(after, LIGHT.inserted)) == 1
    assert len(filled(after, LIGHT.outline)) == len(filled(before, LIGHT.outline)) + 2


def test_whoever_is_small_is_drawn_large_enough_to_be_seen(build_scene):
    path = np.zeros((2, 20, 3))
    path[1, :, 0] = 20.0
    scene = build_scene(path, [AgentType.VEHICLE, AgentType.PEDESTRIAN])
    far = View((0.0, 0.0), 1.0, 100.0, 100.0)

    (body,) = filled(crowd_marks(show_log(scene), view=far), LIGHT.initial)

    assert np.ptp(body.points_px[:, 1]) == pytest.approx(AGENTS.least_px, rel=0.02)


def test_a_trail_is_as_long_as_three_seconds_and_grows_pale(drive):
    marks = crowd_marks(show_log(drive(speed_mps=4.0)), 50.0)
    trail = [mark for mark in marks if not mark.closed]

    assert len(trail) == AGENTS.trail_bands
    assert all(one.alpha > other.alpha for one, other in pairwise(trail))
    points = np.concatenate([mark.points_px for mark in trail])
    assert np.ptp(points[:, 0]) == pytest.approx(10.0 * 4.0 * 3.0, rel=0.05)


def test_whoever_stands_has_no_trail(parked):
    assert all(mark.closed for mark in crowd_marks(show_log(parked()), 50.0))


def test_a_trail_does_not_reach_over_a_gap(drive):
    scene = drive(speed_mps=4.0)
    valid = scene.tracks.valid.copy()
    valid[0, 40:45] = False
    scene = replace(scene, tracks=replace(scene.tracks, valid=valid))

    trail = [m for m in crowd_marks(show_log(scene), 50.0) if not m.closed]

    points = np.concatenate([mark.points_px for mark in trail])
    assert np.ptp(points[:, 0]) == pytest.approx(10.0 * 4.0 * 0.5)


def test_a_ring_grows_around_a_newcomer(crossing):
    shown = show_rollout(with_newcomer(replay(crossing()), 40))
    sizes = []
    for time in (42.0, 48.0):
        rings = [
            mark
            for mark in crowd_marks(shown, time, View((0.0, 0.0), 2.0, 400.0, 400.0))
            if mark.line == LIGHT.inserted and mark.closed
        ]
        sizes += [np.ptp(ring.points_px[:, 0]) for ring in rings]

    assert len(sizes) == 2
    assert sizes[0] < sizes[1]


def test_who_is_far_away_is_not_drawn(drive):
    assert not crowd_marks(show_log(drive()), view=View((500.0, 0.0), 10.0, 400.0, 200.0))


def test_dashes_and_gaps_are_as_long_as_they_should_be():
    line = np.array([[0.0, 0.0], [7.0, 0.0], [7.0, 5.0]])

    parts = list(dashes(line, [3.0, 2.0]))

    np.testing.assert_allclose(parts[0], [[0, 0], [3, 0]])
    np.testing.assert_allclose(parts[1], [[5, 0], [7, 0], [7, 1]])
    np.testing.assert_allclose(parts[2], [[7, 3], [7, 5]])
    assert len(parts) == 3


def test_a_line_is_kept_as_far_as_it_may_be_seen():
    line = np.array([[-500, 50], [-300, 50], [500, 50], [600, 50], [700, 50]], float)

    (kept,) = within(line, VIEW, 5.0)

    np.testing.assert_allclose(kept, line[1:3])


def test_roads_lie_under_paint_and_edges(build_map):
    street = np.array([[-10.0, 0.0], [10.0, 0.0]])
    drawn = draw_map(
        build_map(
            [
                (1, FeatureType.ROAD_EDGE, 1, street - 2),
                (2, FeatureType.ROAD_LINE, RoadLineType.SOLID_SINGLE_YELLOW, street + 1),
                (3, FeatureType.LANE, 2, street),
                (4, FeatureType.STOP_SIGN, 0, street[:1]),
            ]
        )
    )

    colours = [mark.line or mark.fill for mark in map_marks(drawn, VIEW, LIGHT)]

    order = list(dict.fromkeys(colours))
    assert order == [LIGHT.road, LIGHT.lane, LIGHT.yellow, LIGHT.edge, LIGHT.white]


def test_a_map_without_lines_is_no_marks(build_map):
    assert not list(map_marks(draw_map(build_map([])), VIEW, LIGHT))


@pytest.mark.parametrize(
    ("state", "colour", "size_px"),
    [
        (SignalState.STOP, LIGHT.stop, (7.2, 27.0)),
        (SignalState.CAUTION, LIGHT.caution, (23.4, 23.4)),
        (SignalState.GO, LIGHT.go, (18.0, 18.0)),
    ],
)
def test_lights_differ_by_colour_and_by_shape(drive, build_signals, state, colour, size_px):
    scene = drive(signals=build_signals([(step, 1, state) for step in range(91)]))

    (mark,) = light_marks(find_lights(scene), 5.0, VIEW, LIGHT)

    assert mark.fill == colour
    np.testing.assert_allclose(np.ptp(mark.points_px, axis=0), size_px, rtol=0.02)


def test_once_the_log_is_over_lights_are_held_and_pale(drive, build_signals):
    scene = drive(signals=build_signals([(step, 1, SignalState.GO) for step in range(91)]))

    (mark,) = light_marks(find_lights(scene), 200.0, VIEW, LIGHT)

    assert mark.alpha == LIGHTS.held_alpha


def test_all_of_a_scene_is_the_map_and_then_whoever_is_on_it(drive):
    view_model = make_view_model(drive(), ())
    crowd = AgentMarks(view_model.showings[0])

    marks = list(all_marks(view_model, crowd, 10.0, VIEW, LIGHT))

    fills = [mark.fill or mark.line for mark in marks]
    assert fills.index(LIGHT.edge) < fills.index(LIGHT.ego)
