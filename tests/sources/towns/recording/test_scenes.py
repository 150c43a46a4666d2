"""From a town and its traffic to a scene: a town made by hand around a crossing."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from infgen.geometry import to_world
from infgen.scene import AgentType, FeatureType, SignalState
from infgen.sources.towns.recording.scenes import NOW, Place, record
from infgen.sources.towns.recording.signals import SEEN_M, draw_signals
from infgen.sources.towns.recording.viewpoints import View, draw_views
from infgen.sources.towns.streets.road_edges import draw_road_edges
from infgen.sources.towns.streets.road_map import Furniture, draw_map
from infgen.sources.towns.streets.surroundings import Surroundings
from infgen.sources.towns.town import Town, stream
from infgen.sources.towns.traffic.motion import Bodies

STEPS = 120
RIM_M = 125.0
PLACE = Place(0.7, np.array([100.0, -50.0]), np.array([0.01, 0.0]), 5.0)


@pytest.fixture(scope="module")
def town(crossing):
    """A car drives 60 m east along the street; another one stands by, and one is parked."""
    along_m = np.linspace(20.0, 80.0, STEPS)
    pose = np.zeros((2, STEPS, 3))
    pose[0, :, 0], pose[0, :, 1] = along_m - 50.0, -4.5
    pose[1, :, :2] = (-20.0, 4.5)
    velocity_mps = np.zeros((2, STEPS, 2))
    velocity_mps[0, :, 0] = 60.0 / (0.1 * (STEPS - 1))
    furniture = Furniture([], list(draw_road_edges(crossing)), [], [], [], [])
    road_map, lane_ids = draw_map(crossing, furniture)
    return Town(
        network=crossing,
        road_map=road_map,
        lane_ids=lane_ids,
        surroundings=Surroundings(
            walls=np.empty((0, 6)),
            parked=np.array([[10.0, 12.0, 0.3, 4.8, 2.0, 1.6]]),
            people=np.array([[0.0, -12.0, 0.0, 0.9, 0.9, 1.7]]),
            driveways=(),
        ),
        kind=np.full(2, AgentType.VEHICLE, np.int64),
        size_lwh_m=np.array([[4.8, 2.0, 1.6]] * 2),
        car=np.array([True, True]),
        bodies=Bodies(pose, velocity_mps, np.ones((2, STEPS), bool)),
        begins_s=35.0,
    )


@pytest.fixture(scope="module")
def views(town):
    return draw_views(town, 2, 40, RIM_M, np.random.default_rng(0))


@pytest.fixture(scope="module")
def scene(town, views):
    return record("made", town, views[0], 40, PLACE, np.random.default_rng(1))


def far_from_ends(town, metres):
    for name in town.network.ends:
        town.network.places_m[name] = tuple(
            metres * np.sign(np.array(town.network.places_m[name]))
        )


@pytest.fixture(scope="module", autouse=True)
def long_arms(town):
    """Let the streets seem to end far away, or nobody could record there."""
    before = dict(town.network.places_m)
    far_from_ends(town, 500.0)
    yield
    town.network.places_m.update(before)


def test_the_car_that_moves_records(views):
    assert views[0].ego == 0
    assert views[0].start % 20 == 0


def test_views_begin_as_often_as_is_said(town):
    views = draw_views(town, 9, 40, RIM_M, np.random.default_rng(0), start_every=40)

    assert {view.start for view in views} == {0, 40}


def test_who_sets_off_later_is_chosen_while_it_still_stands(town):
    velocity_mps = np.zeros((2, STEPS, 2))
    velocity_mps[1, 60:, 0] = 10.0
    waits = replace(town, bodies=replace(town.bodies, velocity_mps=velocity_mps))

    drawn = [
        draw_views(waits, 1, 40, RIM_M, np.random.default_rng(at))[0] for at in range(200)
    ]

    # By the way it goes while it is recorded, one in a hundred.
    assert 0.05 < np.mean([view == View(1, 0) for view in drawn]) < 0.2
    assert np.mean([view.ego == 0 for view in drawn]) < 0.1


def test_at_any_time_alike_what_a_car_does_next_does_not_matter(town):
    velocity_mps = np.zeros((2, STEPS, 2))
    velocity_mps[1, 60:, 0] = 10.0
    sets_off, stops = (
        replace(town, bodies=replace(town.bodies, velocity_mps=each))
        for each in (velocity_mps, velocity_mps[:, ::-1])
    )

    def draw(at_any_time):
        return [
            Counter(
                view.start
                for at in range(200)
                for view in draw_views(
                    each, 1, 40, RIM_M, np.random.default_rng(at), at_any_time=at_any_time
                )
            )
            for each in (sets_off, stops)
        ]

    before, after = draw(at_any_time=True)
    assert before == after
    assert max(before.values()) < 1.5 * min(before.values())
    before, after = draw(at_any_time=False)
    assert before != after


def test_no_two_views_are_of_one_car_at_one_time(town):
    views = draw_views(town, 20, 40, RIM_M, np.random.default_rng(0))

    taken = [(view.ego, view.start + step) for view in views for step in range(40)]
    assert len(set(taken)) == len(taken)
    assert len(views) >= 4


def test_nobody_records_near_the_rim_of_the_town(town):
    far_from_ends(town, 150.0)
    inside, at_rim = (
        draw_views(town, 5, 40, rim_m, np.random.default_rng(0)) for rim_m in (50.0, 250.0)
    )
    far_from_ends(town, 500.0)

    assert inside
    assert not at_rim


def test_everyone_in_sight_is_in_the_scene_the_ego_last(scene):
    assert scene.tracks.num_agents == 4
    assert scene.ego == 3
    assert sorted(scene.tracks.agent_type) == [0, 0, 0, AgentType.PEDESTRIAN]
    assert scene.tracks.valid[scene.ego].all()


def test_the_place_turns_and_shifts_poses(scene, town, views):
    window = slice(views[0].start, views[0].start + 40)
    pose = town.bodies.pose[0, window]
    world = to_world(pose, np.broadcast_to([100.0, -50.0, 0.7], pose.shape))

    xy_m = scene.tracks.xyz_m[scene.ego, :, :2] + scene.origin_xyz_m[:2]
    np.testing.assert_allclose(xy_m, world[:, :2], atol=1e-3)
    np.testing.assert_allclose(scene.tracks.heading_rad[scene.ego], 0.7, atol=1e-3)


def test_boxes_stand_on_the_slope(scene):
    tracks = scene.tracks
    x_m = tracks.xyz_m[..., 0] + scene.origin_xyz_m[0]
    bottom_m = tracks.xyz_m[..., 2] + scene.origin_xyz_m[2] - tracks.size_lwh_m[..., 2] / 2

    ground_m = 5.0 + 0.01 * (x_m - 100.0)
    np.testing.assert_allclose(bottom_m[tracks.valid], ground_m[tracks.valid], atol=2e-3)


def test_cars_that_stand_do_not_tremble_and_people_do(scene):
    tracks = scene.tracks
    for row in range(3):
        xy_m = tracks.xyz_m[row, tracks.valid[row], :2]
        moved_m = np.ptp(xy_m, axis=0).max()
        assert (moved_m > 0.01) == (tracks.agent_type[row] == AgentType.PEDESTRIAN)


def test_the_map_is_of_the_same_place(scene):
    lanes = scene.road_map.rows(FeatureType.LANE)
    points_m = np.concatenate([scene.road_map.points(int(row)) for row in lanes])
    from_ego_m = points_m[:, :2] - scene.tracks.xyz_m[scene.ego, NOW, :2]

    # The middle of its lane is 1.75 m away.
    assert 1.7 < np.linalg.norm(from_ego_m, axis=1).min() < 1.9


@pytest.mark.parametrize(
    ("steps", "far_mps", "whole"), [(92, 0.1, False), (92, 50.0, True), (91, 50.0, False)]
)
def test_a_long_log_has_the_map_as_far_as_one_gets_in_its_time(
    monkeypatch, town, views, steps, far_mps, whole
):
    monkeypatch.setattr("infgen.sources.towns.recording.scenes.MAP_REACH_M", 2.0)
    monkeypatch.setattr("infgen.sources.towns.recording.scenes.FAR_MPS", far_mps)

    view = View(views[0].ego, 0)
    scene = record("made", town, view, steps, PLACE, np.random.default_rng(1))

    kept, there = len(scene.road_map.feature_id), len(town.road_map.feature_id)
    assert 0 < kept <= there
    assert (kept == there) == whole


def test_lights_are_recorded_while_they_are_near(town):
    eye_m = np.array([[0.0, 0.0], [SEEN_M + 30.0, 0.0], [0.0, 0.0]])

    signals = draw_signals(town, town.road_map, 0, eye_m)

    assert set(signals.step) == {0, 2}
    assert (signals.step == 0).sum() == 14  # All ways across the junction.
    shown = {SignalState(state) for state in signals.state}
    assert shown & {SignalState.GO, SignalState.ARROW_GO}
    assert shown & {SignalState.STOP, SignalState.ARROW_STOP}


def test_lights_are_those_of_the_time_at_which_the_town_is_recorded(town):
    here = np.zeros((20, 2))
    later = replace(town, begins_s=town.begins_s + 4.0)

    one = draw_signals(town, town.road_map, 40, here)
    same = draw_signals(later, town.road_map, 0, here)
    other = draw_signals(town, town.road_map, 0, here)

    np.testing.assert_array_equal(one.state, same.state)
    assert (one.state != other.state).any()


def test_random_streams_depend_on_their_words_alone():
    one, same, other = stream("a", 1), stream("a", 1), stream("a", 2)

    assert one.random() == same.random()
    assert one.random() != other.random()
