"""Observations: what is near, in the frame of the ego, wherever the scene lies."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import flatten

from infgen.environment.observation import AGENTS, EGO, MAP, SIGNALS
from infgen.geometry import rotate
from infgen.scene import AgentType, SignalState
from infgen.tokens.map import PolylineType


def column(table, names, name):
    return table[..., names.index(name)]


def moved(scene, turn_rad, by_m):
    """The same scene elsewhere, turned about its origin."""

    angle_rad = np.full(1, turn_rad, dtype=np.float32)

    def place(xyz_m):
        xy_m = rotate(xyz_m[..., :2], angle_rad) + np.float32(by_m)
        return np.concatenate([xy_m, xyz_m[..., 2:]], axis=-1).astype(np.float32)

    tracks, road_map, signals = scene.tracks, scene.road_map, scene.signals
    heading_rad = (tracks.heading_rad + turn_rad + np.pi) % (2 * np.pi) - np.pi
    return replace(
        scene,
        tracks=replace(
            tracks,
            xyz_m=place(tracks.xyz_m),
            heading_rad=heading_rad.astype(np.float32),
            velocity_mps=rotate(tracks.velocity_mps, angle_rad),
        ),
        road_map=replace(road_map, xyz_m=place(road_map.xyz_m)),
        signals=replace(signals, stop_xyz_m=place(signals.stop_xyz_m)),
    )


@pytest.fixture
def seen(drive_env):
    """``seen(scene, **settings)``: the first observation of an episode."""

    def look(scene, **settings):
        observed, _ = drive_env(scene, **settings).reset(seed=0)
        return observed

    return look


def test_the_ego_sees_itself(drive, seen):
    ego = seen(drive(speed_mps=12.0))["ego"]

    told = dict(zip(EGO, ego.tolist(), strict=True))
    assert told["speed_mps"] == pytest.approx(12.0, abs=1e-4)
    assert told["length_m"] == pytest.approx(4.8)
    assert told["width_m"] == pytest.approx(2.0)
    assert told["route_left_m"] == pytest.approx(0.0, abs=1e-5)
    assert (told["route_heading_cos"], told["route_heading_sin"]) == (1.0, 0.0)


def test_another_car_is_seen_where_it_is_from_the_ego(crossing, seen):
    # Now the ego is at (-30, 0) facing east; a car at (0, -50) drives north at 10 m/s, a
    # cyclist at (36, 2) west at 4 m/s. The pedestrian is not seen yet.
    observed = seen(crossing())
    agents = observed["agents"]

    assert observed["agents_mask"].sum() == 2
    car, cyclist = agents[0], agents[1]
    np.testing.assert_allclose(car[:6], [30, -50, 0, 1, 0, 10], atol=1e-4)
    np.testing.assert_allclose(cyclist[:6], [66, 2, -1, 0, -4, 0], atol=1e-4)
    np.testing.assert_allclose(car[6:], [4.8, 2.0, 1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(cyclist[6:], [2.0, 1.0, 0, 0, 1], atol=1e-5)
    assert not agents[2:].any()


def test_only_the_nearest_are_seen_and_none_beyond_the_radius(parked, seen):
    def ahead_m(**settings):
        observed = seen(parked(5), **settings)
        return column(observed["agents"], AGENTS, "x_m")[observed["agents_mask"] > 0]

    np.testing.assert_allclose(ahead_m(), [8, 16, 24, 32, 40], atol=1e-4)
    np.testing.assert_allclose(ahead_m(num_agents=2), [8, 16], atol=1e-4)
    np.testing.assert_allclose(ahead_m(radius_m=25.0), [8, 16, 24], atol=1e-4)


def test_the_map_around_is_seen(drive, seen):
    observed = seen(drive(), num_map_tokens=32)
    lines = observed["map"][observed["map_mask"] > 0]

    lanes = lines[column(lines, MAP, f"is_{PolylineType.LANE.name.lower()}") == 1]
    edges = lines[column(lines, MAP, f"is_{PolylineType.ROAD_EDGE.name.lower()}") == 1]
    assert len(lanes) > 5
    assert len(edges) > 5
    np.testing.assert_allclose(column(lanes, MAP, "y_m"), 0.0, atol=1e-4)
    np.testing.assert_allclose(column(edges, MAP, "y_m"), -3.0, atol=1e-4)
    np.testing.assert_allclose(column(lanes, MAP, "heading_cos"), 1.0, atol=1e-4)
    away_m = np.hypot(lines[:, 0], lines[:, 1])
    assert (np.diff(away_m) >= -1e-4).all(), "nearest first"


def test_a_signal_is_seen_where_its_lane_begins(drive, build_signals, seen):
    lane, steps = 1, range(11)
    red = build_signals([(step, lane, SignalState.STOP) for step in steps])

    observed = seen(drive(signals=red), radius_m=150.0)

    assert observed["signals_mask"].tolist() == [1, 0, 0, 0]
    told = dict(zip(SIGNALS, observed["signals"][0].tolist(), strict=True))
    # The lane begins at x = -100; the ego is at x = 10.
    assert told["x_m"] == pytest.approx(-110.0, abs=1e-3)
    assert (told["is_stop"], told["is_go"]) == (1.0, 0.0)


def test_without_map_or_signals_all_is_masked(drive, build_map, seen):
    observed = seen(drive(road_map=build_map([])))

    assert not observed["map_mask"].any()
    assert not observed["signals_mask"].any()
    assert not observed["map"].any()


def test_the_route_ahead_is_seen(drive, seen):
    # 90 m of lane are left; the points are 5 m apart, and none is beyond the end.
    observed = seen(drive(speed_mps=10.0), num_route_points=20)

    expected = np.minimum(5.0 * np.arange(1, 21), 90.0)
    np.testing.assert_allclose(observed["route"][:, 0], expected, atol=1e-4)
    np.testing.assert_allclose(observed["route"][:, 1], 0.0, atol=1e-4)


@pytest.mark.parametrize(("turn_rad", "by_m"), [(0.0, (500, 0)), (2.0, (-80, 40))])
def test_nothing_depends_on_where_the_scene_lies(crossing, drive_env, turn_rad, by_m):
    scene = crossing()
    # No token lies on the rim, and none is left out: which one would be up to rounding.
    sees = {"standing": True, "radius_m": 62.3, "num_map_tokens": 128}
    here = drive_env(scene, **sees)
    there = drive_env(moved(scene, turn_rad, by_m), **sees)
    action = np.array([1.0, 0.1], dtype=np.float32)

    pairs = [(here.reset(seed=0)[0], there.reset(seed=0)[0])]
    for _ in range(7):
        pairs.append((here.step(action)[0], there.step(action)[0]))

    for one, other in pairs:
        np.testing.assert_array_equal(one["agents_mask"], other["agents_mask"])
        for name in ("ego", "agents", "route"):
            np.testing.assert_allclose(one[name], other[name], atol=2e-3, err_msg=name)
        # Tokens at equal distances may change places.
        places = [np.sort(observed["map"], axis=0) for observed in (one, other)]
        np.testing.assert_allclose(*places, atol=5e-3)


def test_a_flat_observation_is_that_of_gymnasium(crossing, drive_env):
    tables, flat = drive_env(crossing()), drive_env(crossing(), observation="flat")

    named, _ = tables.reset(seed=1)
    values, _ = flat.reset(seed=1)

    assert flat.observation_space.contains(values)
    np.testing.assert_array_equal(values, flatten(tables.observation_space, named))


def test_every_agent_type_has_a_column():
    assert [f"is_{each.name.lower()}" for each in list(AgentType)[:3]] == list(AGENTS[-3:])
