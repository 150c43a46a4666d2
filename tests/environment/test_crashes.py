"""Episodes end in collisions and off the road, when one can compute that they do."""

import numpy as np
import pytest
from gymnasium import logger

from infgen.scene import FeatureType, RoadEdgeType


@pytest.fixture(autouse=True)
def _quiet(monkeypatch):
    monkeypatch.setattr(logger, "min_level", logger.ERROR)


def drive_until_it_ends(env, action, most=100, **reset):
    env.reset(seed=0, **reset)
    for step in range(1, most + 1):
        _, reward, terminated, truncated, info = env.step(np.float32(action))
        if terminated or truncated:
            return step, reward, terminated, info
    raise AssertionError(f"the episode goes on after {most} steps")


def test_an_episode_ends_when_the_ego_hits_who_stands_ahead(parked, build_scene, drive_env):
    # The ego at 10 m/s, 4.8 m long as the car ahead: 20 m from middle to middle are a gap
    # of 15.2 m. After 15 steps it is 0.2 m wide, after 16 the boxes overlap by 0.8 m.
    steps = np.arange(11)
    ego = np.stack([steps - 10.0, 0 * steps, 0 * steps], axis=-1)
    other = np.tile([20.0, 0.0, 0.0], (11, 1))
    env = drive_env(build_scene(np.stack([ego, other]), [0, 0]), standing=True)

    step, reward, terminated, info = drive_until_it_ends(env, [0.0, 0.0])

    assert (step, terminated) == (16, True)
    assert info["collisions"] == 1
    assert info["distance_m"] == pytest.approx(16.0, abs=1e-5)
    assert reward == pytest.approx(0.1 * 1.0 - 5.0, abs=1e-5)


def test_who_only_passes_hits_nobody(build_scene, drive_env):
    # 2.5 m from middle to middle of cars that are 2 m wide.
    steps = np.arange(11)
    ego = np.stack([steps - 10.0, 0 * steps, 0 * steps], axis=-1)
    other = np.tile([10.0, 2.5, 0.0], (11, 1))
    env = drive_env(build_scene(np.stack([ego, other]), [0, 0]), standing=True)
    env.reset(seed=0)

    ends = [env.step(np.zeros(2, np.float32))[2] for _ in range(25)]

    assert not any(ends)


def test_an_episode_ends_when_a_corner_leaves_the_road(drive, drive_env):
    # The edge is at y = -3. By waypoints 0.25 m to the right per step the right side, at
    # -1 m now, is beyond -3 m after the ninth step: -1 - 9 * 0.25 = -3.25.
    env = drive_env(drive(speed_mps=10.0), action="waypoint")

    step, reward, terminated, info = drive_until_it_ends(env, [1.0, -0.25, 0.0])

    assert (step, terminated) == (9, True)
    assert info["collisions"] == 0
    assert reward < -4.5


def test_at_2_hz_an_episode_ends_with_the_step_in_which_it_happens(drive, drive_env):
    env = drive_env(drive(speed_mps=10.0), action="waypoint", hz=2)

    # The same way, five times as much in each step: the ninth 0.1 s is in the second.
    step, _, terminated, info = drive_until_it_ends(env, [5.0, -1.25, 0.0])

    assert (step, terminated) == (2, True)
    assert info["seconds"] == pytest.approx(1.0)


def test_a_map_without_road_edges_has_no_off_road(drive, build_map, drive_env):
    env = drive_env(drive(road_map=build_map([])), action="waypoint", max_seconds=2.0)

    step, _, terminated, _ = drive_until_it_ends(env, [1.0, -0.9, 0.0])

    assert (step, terminated) == (20, False)


def test_who_begins_off_the_road_may_get_back(build_map, drive, drive_env):
    x_m = np.arange(-100.0, 101.0)
    # The road is to the left of its edge: the ego begins 2 m to the right of it.
    edge = np.column_stack([x_m, 0 * x_m + 2.0])
    kind = (1, FeatureType.ROAD_EDGE, RoadEdgeType.BOUNDARY, edge)
    env = drive_env(drive(road_map=build_map([kind])), action="waypoint", max_seconds=3.0)
    env.reset(seed=0)

    there = [env.step(np.float32([1.0, 0.25, 0.0]))[2] for _ in range(14)]
    back = [env.step(np.float32([1.0, -0.25, 0.0]))[2] for _ in range(4)]

    assert not any(there)  # At y = 3.5 m now, its right side at 2.5 m.
    assert back == [False, False, True, True]


def test_who_begins_in_another_box_may_get_out(build_scene, drive_env):
    # The log has both boxes overlap; the ego drives out of the other.
    steps = np.arange(11)
    ego = np.stack([steps - 10.0, 0 * steps, 0 * steps], axis=-1)
    other = np.tile([0.0, 1.0, 0.0], (11, 1))
    env = drive_env(build_scene(np.stack([ego, other]), [0, 0]), standing=True)
    env.reset(seed=0)

    ends = [env.step(np.zeros(2, np.float32))[2] for _ in range(10)]

    assert not any(ends)
