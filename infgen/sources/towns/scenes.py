"""Synthetic scenes: a town, its traffic, and what one car records of it."""

import hashlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int32, Int64

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.scene import AgentKind, Scene, Tracks
from infgen.sources.towns.build import draw_town
from infgen.sources.towns.demand import Users, draw_users
from infgen.sources.towns.motion import poses
from infgen.sources.towns.roads import Place, draw_map, draw_signals
from infgen.sources.towns.routes import find_routes
from infgen.sources.towns.sight import Actors, seen
from infgen.sources.towns.town import Town
from infgen.sources.towns.traffic import Traffic, simulate

NUM_STEPS = 91
NOW = 10
WARM_UP_STEPS = 150
"""Traffic runs so long before anyone records it."""
MIN_VALID_STEPS = 5
"""Tracks seen for less are not in the record."""
MAX_PREDICT = 8
EGO_NEAR_M = 40.0
"""How fast the chance to be the recording car falls with the distance from the junction."""
EGO_WIDTH_M, EGO_HEIGHT_M = 2.1, 2.05
"""The recording car carries its sensors on the outside."""

_GRID_M, _GRID_RAD, _GRID_MPS = 2.0**-11, 2.0**-12, 2.0**-8
"""Recorded values are rounded: finely enough to differentiate, and records pack better."""
_LONGEST_EGO_M = 5.6
_WINDOW = slice(WARM_UP_STEPS, WARM_UP_STEPS + NUM_STEPS)


def draw_scenes(seed: int, split: str, first: int, count: int) -> Iterator[Scene]:
    """Draw scenes of a split by number. Each depends on seed, split and number alone."""
    for number in range(first, first + count):
        yield draw_scene(seed, split, number)


def draw_scene(seed: int, split: str, number: int) -> Scene:
    """Draw one scene."""
    name = hashlib.sha256(f"towns/{seed}/{split}/{number}".encode())
    attempt = 0
    while True:
        stream = np.frombuffer(name.digest()[:16], np.uint32).tolist()
        rng = np.random.default_rng([attempt, *stream])
        scene = _try_scene(name.hexdigest()[:16], rng)
        if scene is not None:
            return scene
        attempt += 1


def _try_scene(scenario_id: str, rng: np.random.Generator) -> Scene | None:
    """Draw a scene; None if in its town nobody is under way all the time."""
    town = draw_town(rng)
    routes = find_routes(town)
    num_steps = WARM_UP_STEPS + NUM_STEPS
    users = draw_users(town, routes, num_steps * CLOCK.step_s, rng)
    traffic = simulate(town, routes, users, num_steps, rng)
    pose = poses(routes, users, traffic)
    ego = _choose_ego(users, traffic, pose, rng)
    if ego is None:
        return None
    users = _with_sensors(users, ego)
    actors = _actors(town, users, traffic, pose)
    still_mps = np.zeros((len(town.parked), NUM_STEPS))
    speed_mps = np.concatenate([traffic.speed_mps[:, _WINDOW], still_mps])
    shown = seen(actors, ego, town.buildings, rng)
    return _record(scenario_id, town, actors, speed_mps, shown, ego, rng)


def _choose_ego(
    users: Users,
    traffic: Traffic,
    pose: Float64[np.ndarray, "user step 3"],
    rng: np.random.Generator,
) -> int | None:
    """Choose a car that is there all the time, rather one that moves near the junction."""
    lasting = traffic.present[:, _WINDOW].all(axis=1)
    car = (users.kind == AgentKind.VEHICLE) & (users.size_lwh_m[:, 0] < _LONGEST_EGO_M)
    able = np.flatnonzero(lasting & car)
    if not len(able):
        return None
    way_m = traffic.speed_mps[able, _WINDOW].sum(axis=1) * CLOCK.step_s
    apart_m = np.linalg.norm(pose[able, WARM_UP_STEPS + NOW, :2], axis=1)
    weight = (4.0 + way_m) * np.exp(-apart_m / EGO_NEAR_M)
    return int(rng.choice(able, p=weight / weight.sum()))


def _with_sensors(users: Users, ego: int) -> Users:
    size_lwh_m = users.size_lwh_m.copy()
    size_lwh_m[ego, 1:] = EGO_WIDTH_M, EGO_HEIGHT_M
    return replace(users, size_lwh_m=size_lwh_m)


def _actors(
    town: Town, users: Users, traffic: Traffic, pose: Float64[np.ndarray, "user step 3"]
) -> Actors:
    """Gather moving users and parked cars over the recorded steps."""
    parked = np.broadcast_to(town.parked[:, None, :3], (len(town.parked), NUM_STEPS, 3))
    return Actors(
        kind=np.append(users.kind, np.full(len(parked), AgentKind.VEHICLE)).astype(
            np.int64
        ),
        size_lwh_m=np.concatenate([users.size_lwh_m, town.parked[:, 3:]]),
        pose=np.concatenate([pose[:, _WINDOW], parked]),
        present=np.concatenate(
            [traffic.present[:, _WINDOW], np.ones(parked.shape[:2], bool)]
        ),
    )


def _record(
    scenario_id: str,
    town: Town,
    actors: Actors,
    speed_mps: Float64[np.ndarray, "actor step"],
    shown: Bool[np.ndarray, "actor step"],
    ego: int,
    rng: np.random.Generator,
) -> Scene:
    """Write down what was seen, as WOMD would."""
    place = _place(rng)
    kept = _kept(shown, ego, rng)
    tracks, origin_xyz_m = _tracks(actors, speed_mps, shown, kept, place)
    road_map, lane_ids = draw_map(town, place, origin_xyz_m)
    start_s = WARM_UP_STEPS * CLOCK.step_s
    predict, difficulty = _to_predict(tracks)
    return Scene(
        scenario_id=scenario_id,
        origin_xyz_m=origin_xyz_m,
        timestamps_s=np.arange(NUM_STEPS) * CLOCK.step_s,
        now=NOW,
        ego=len(kept) - 1,
        predict_row=predict,
        predict_difficulty=difficulty,
        interest_id=_of_interest(tracks, predict),
        tracks=tracks,
        road_map=road_map,
        signals=draw_signals(town, road_map, lane_ids, start_s, NUM_STEPS),
    )


def _place(rng: np.random.Generator) -> Place:
    return Place(
        turn_rad=float(rng.uniform(-np.pi, np.pi)),
        shift_m=np.round(rng.uniform(-8000.0, 8000.0, 2)),
        slope=rng.normal(0.0, 0.012, 2),
        height_m=float(rng.uniform(-10.0, 150.0)),
    )


def _kept(
    shown: Bool[np.ndarray, "actor step"], ego: int, rng: np.random.Generator
) -> Int64[np.ndarray, " agent"]:
    """Rows of the actors that make a track, in any order, the ego last."""
    enough = shown.sum(axis=1) >= MIN_VALID_STEPS
    enough[ego] = False
    return np.append(rng.permutation(np.flatnonzero(enough)), ego)


def _tracks(
    actors: Actors,
    speed_mps: Float64[np.ndarray, "actor step"],
    shown: Bool[np.ndarray, "actor step"],
    kept: Int64[np.ndarray, " agent"],
    place: Place,
) -> tuple[Tracks, Float64[np.ndarray, "3"]]:
    """Write the tracks of the kept actors around the whole metres nearest to the ego."""
    pose, valid = actors.pose[kept], shown[kept]
    size_lwh_m = _rounded(actors.size_lwh_m[kept], _GRID_M)
    xy_m = place.xy_m(pose[..., :2])
    z_m = place.ground_m(xy_m) + size_lwh_m[:, None, 2] / 2
    xyz_m = _rounded(np.concatenate([xy_m, z_m[..., None]], axis=-1), _GRID_M)
    heading_rad = wrap_angle(pose[..., 2] + place.turn_rad)
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    velocity_mps = _rounded(speed_mps[kept][..., None] * ahead, _GRID_MPS)
    origin_xyz_m = np.round(xyz_m[-1, NOW])
    # The record holds zeros where nothing was seen.
    world_m = np.where(valid[..., None], xyz_m, 0.0)
    return Tracks(
        id=(kept + 1).astype(np.int32),
        kind=actors.kind[kept].astype(np.int8),
        xyz_m=(world_m - origin_xyz_m).astype(np.float32),
        heading_rad=_where(valid, _rounded(heading_rad, _GRID_RAD)),
        velocity_mps=_where(valid, velocity_mps),
        size_lwh_m=_where(valid, np.broadcast_to(size_lwh_m[:, None], xyz_m.shape)),
        valid=valid,
    ), origin_xyz_m


def _rounded(values: Float64[np.ndarray, "..."], grid: float) -> Float64[np.ndarray, "..."]:
    return np.round(values / grid) * grid


def _where(
    valid: Bool[np.ndarray, "agent step"], values: Float64[np.ndarray, "agent step ..."]
) -> Float32[np.ndarray, "agent step ..."]:
    """Keep the valid values, zeros elsewhere."""
    shape = valid.shape + (1,) * (values.ndim - 2)
    return np.where(valid.reshape(shape), values, 0.0).astype(np.float32)


def _to_predict(
    tracks: Tracks,
) -> tuple[Int32[np.ndarray, " predict"], Int8[np.ndarray, " predict"]]:
    """Choose tracks seen now and long after: first all kinds, then whoever moves most."""
    others = np.arange(tracks.num_agents) < tracks.num_agents - 1
    long_seen = tracks.valid[:, NOW] & (tracks.valid[:, NOW:].mean(axis=1) > 0.6)
    able = np.flatnonzero(others & long_seen)
    speed_mps = np.linalg.norm(tracks.velocity_mps[able], axis=-1).mean(axis=1)
    _, first = np.unique(tracks.kind[able], return_index=True)
    foremost = np.isin(np.arange(len(able)), first)
    order = np.lexsort((able, -speed_mps, ~foremost))
    chosen = np.sort(able[order][:MAX_PREDICT])
    turned_rad = np.ptp(np.where(tracks.valid, np.unwrap(tracks.heading_rad), 0.0), axis=1)
    hard = (tracks.kind != AgentKind.VEHICLE) | (turned_rad > 0.5)
    return chosen.astype(np.int32), np.where(hard[chosen], 2, 1).astype(np.int8)


def _of_interest(
    tracks: Tracks, predict: Int32[np.ndarray, " predict"]
) -> Int32[np.ndarray, " interest"]:
    """Name the two tracks to predict that come nearest to each other."""
    if len(predict) < 2:
        return np.zeros(0, np.int32)
    xy_m = tracks.xyz_m[predict, :, :2]
    both = tracks.valid[predict][:, None] & tracks.valid[predict][None]
    apart_m = np.linalg.norm(xy_m[:, None] - xy_m[None], axis=-1)
    nearest_m = np.where(both, apart_m, np.inf).min(axis=-1)
    nearest_m[np.diag_indices(len(predict))] = np.inf
    one, other = np.unravel_index(nearest_m.argmin(), nearest_m.shape)
    return tracks.id[predict[[one, other]]]
