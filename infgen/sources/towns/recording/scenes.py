"""Scenes: what one car of a town records, written down as WOMD would."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from infgen.clock import CLOCK
from infgen.geometry import rotate, wrap_angle
from infgen.scene import AgentType, RoadMap, Scene, Tracks
from infgen.sources.towns.recording.signals import draw_signals
from infgen.sources.towns.recording.tracks_to_predict import of_interest, to_predict
from infgen.sources.towns.recording.viewpoints import View
from infgen.sources.towns.recording.visibility import (
    LONGEST_REACH_M,
    Actors,
    seen,
    tracks_of,
    wander,
)
from infgen.sources.towns.streets.road_map import keep_features
from infgen.sources.towns.streets.surroundings import kinds_of
from infgen.sources.towns.town import Town

NOW = 10
MAP_REACH_M = 115.0
"""A log has the map features that come so near to the recording car ..."""
SHORT_STEPS = 91
FAR_MPS = 15.0
"""... or, if it is longer than WOMD's, as far as one gets at this speed in its time: who
plays it may turn where the log did not, and must not come to where the map ends."""
MIN_VALID_STEPS = 3
"""Tracks seen for less are not in the record."""
EGO_WIDTH_M, EGO_HEIGHT_M = 2.3, 2.2
"""The recording car carries its sensors on the outside."""
_LOOK_STEPS = 10
"""What is near is found by looking around every second."""
_WALL_REACH_M = 110.0
_GRID_M, _GRID_RAD, _GRID_MPS = 2.0**-11, 2.0**-12, 2.0**-8
"""Recorded values are rounded: finely enough to differentiate, and records pack better."""
_MAP_GRID_M = 2.0**-8
_SLOPE = 0.012
_NOISE_M, _NOISE_RAD, _NOISE_MPS, _NOISE_S = 0.016, 0.004, 0.05, 0.35
"""Errors of what is measured of others on the move, and how soon they are others."""
_WALKER_NOISE_M, _WALKER_NOISE_RAD = 0.008, 0.02
_SWAY_M, _SWAY_S = 0.04, 3.0
"""Nobody on foot stands like a post."""
_SURE_MPS = 1.0
"""The faster a vehicle is, up to here, the less is sure about it."""


@dataclass(frozen=True, slots=True)
class _Measured:
    """Poses and velocities as a tracker has them."""

    pose: Float64[np.ndarray, "actor step 3"]
    velocity_mps: Float64[np.ndarray, "actor step 2"]


@dataclass(frozen=True, slots=True)
class Place:
    """Where in the world a town stands, and how its ground slopes.

    Attributes:
        turn_rad: World heading of the town's x axis.
        shift_m: World position of its middle.
        slope: Rise along world x and y, in metres per metre.
        height_m: Of the ground at the middle.
    """

    turn_rad: float
    shift_m: Float64[np.ndarray, "2"]
    slope: Float64[np.ndarray, "2"]
    height_m: float

    def xy_m(self, town_m: Float64[np.ndarray, "... 2"]) -> Float64[np.ndarray, "... 2"]:
        """Bring points of the town to the world."""
        turn_rad = np.full(town_m.shape[:-1], self.turn_rad)
        return rotate(town_m, turn_rad) + self.shift_m

    def ground_m(self, world_m: Float64[np.ndarray, "... 2"]) -> Float64[np.ndarray, "..."]:
        """Height of the ground at points of the world."""
        return self.height_m + (world_m - self.shift_m) @ self.slope


def draw_place(rng: np.random.Generator) -> Place:
    """Draw where a town stands."""
    return Place(
        turn_rad=float(rng.uniform(-np.pi, np.pi)),
        shift_m=np.round(rng.uniform(-8000.0, 8000.0, 2)),
        slope=rng.normal(0.0, _SLOPE, 2),
        height_m=float(rng.uniform(-10.0, 150.0)),
    )


def record(
    scenario_id: str,
    town: Town,
    view: View,
    num_steps: int,
    place: Place,
    rng: np.random.Generator,
) -> Scene:
    """Record a view of a town for so many steps."""
    window = slice(view.start, view.start + num_steps)
    actors, velocity_mps, ego = _actors(town, view.ego, window)
    eye_m = actors.pose[ego, :, :2]
    walls = town.surroundings.walls
    walls = walls[_reaches(walls[:, None, :2], eye_m, _WALL_REACH_M)]
    shown = seen(actors, ego, walls, rng)
    kept, valid = _kept(*tracks_of(shown), ego, rng)
    moved = _measured(actors, velocity_mps, ego, rng)
    tracks, origin_xyz_m = _tracks(actors, moved, kept, valid, place)
    cut = _cut_map(town.road_map, eye_m, _map_reach_m(num_steps))
    road_map = _placed(cut, place, origin_xyz_m)
    predict, difficulty = to_predict(tracks, NOW)
    return Scene(
        scenario_id=scenario_id,
        origin_xyz_m=origin_xyz_m,
        timestamps_s=np.arange(num_steps) * CLOCK.step_s,
        now=NOW,
        ego=len(kept) - 1,
        predict_row=predict,
        predict_difficulty=difficulty,
        interest_id=of_interest(tracks, predict),
        tracks=tracks,
        road_map=road_map,
        signals=draw_signals(town, road_map, view.start, eye_m),
    )


def _actors(
    town: Town, ego: int, window: slice
) -> tuple[Actors, Float64[np.ndarray, "actor step 2"], int]:
    """Gather who moves and what stands within reach, with velocities and the ego's row."""
    bodies, around = town.bodies, town.surroundings
    pose, present = bodies.pose[:, window], bodies.present[:, window]
    eye_m = pose[ego, :, :2]
    apart_m = np.linalg.norm(pose[..., :2] - eye_m, axis=-1)
    near = np.flatnonzero((present & (apart_m < LONGEST_REACH_M)).any(axis=1))
    still = np.concatenate([around.parked, around.people])
    by = np.flatnonzero(_reaches(still[:, None, :2], eye_m, LONGEST_REACH_M))
    steps = len(eye_m)
    size_lwh_m = town.size_lwh_m[near].copy()
    size_lwh_m[near == ego, 1:] = EGO_WIDTH_M, EGO_HEIGHT_M
    standing = np.broadcast_to(still[by, None, :3], (len(by), steps, 3))
    return (
        Actors(
            kind=np.concatenate([town.kind[near], kinds_of(around)[by]]),
            size_lwh_m=np.concatenate([size_lwh_m, still[by, 3:]]),
            pose=np.concatenate([pose[near], standing]),
            present=np.concatenate([present[near], np.ones((len(by), steps), bool)]),
        ),
        np.concatenate(
            [bodies.velocity_mps[near][:, window], np.zeros((len(by), steps, 2))]
        ),
        int(np.flatnonzero(near == ego)[0]),
    )


def _reaches(
    points_m: Float64[np.ndarray, "thing point 2"],
    eye_m: Float64[np.ndarray, "step 2"],
    reach_m: float,
) -> Bool[np.ndarray, " thing"]:
    """Which things have a point that the eye comes so near to."""
    found = np.zeros(len(points_m), bool)
    for at_m in eye_m[::_LOOK_STEPS]:
        found |= (np.linalg.norm(points_m - at_m, axis=-1) < reach_m).any(axis=1)
    return found


def _map_reach_m(num_steps: int) -> float:
    """How far from the recording car a log of so many steps still has a map."""
    if num_steps <= SHORT_STEPS:
        return MAP_REACH_M
    return max(MAP_REACH_M, FAR_MPS * num_steps * CLOCK.step_s)


def _cut_map(
    road_map: RoadMap, eye_m: Float64[np.ndarray, "step 2"], reach_m: float
) -> RoadMap:
    """Keep the features that the recording car comes near to."""
    near = np.zeros(len(road_map.xyz_m), bool)
    x_m, y_m = road_map.xyz_m[:, 0], road_map.xyz_m[:, 1]
    for at_m in eye_m[::_LOOK_STEPS].astype(np.float32):
        near |= (x_m - at_m[0]) ** 2 + (y_m - at_m[1]) ** 2 < reach_m**2
    counted = np.concatenate([[0], np.cumsum(near)])
    kept = np.diff(counted[road_map.point_offsets]) > 0
    return keep_features(road_map, kept)


def _placed(
    road_map: RoadMap, place: Place, origin_xyz_m: Float64[np.ndarray, "3"]
) -> RoadMap:
    """Bring a map from the town to the world, around an origin."""
    world_m = place.xy_m(road_map.xyz_m[:, :2].astype(np.float64))
    world_m = np.column_stack([world_m, place.ground_m(world_m)])
    rounded_m = np.round(world_m / _MAP_GRID_M) * _MAP_GRID_M
    return replace(road_map, xyz_m=(rounded_m - origin_xyz_m).astype(np.float32))


def _kept(
    actor: Int64[np.ndarray, " track"],
    valid: Bool[np.ndarray, "track step"],
    ego: int,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " agent"], Bool[np.ndarray, "agent step"]]:
    """Keep tracks that are long enough, in any order, the ego's last."""
    enough = (valid.sum(axis=1) >= MIN_VALID_STEPS) & (actor != ego)
    order = np.append(rng.permutation(np.flatnonzero(enough)), np.flatnonzero(actor == ego))
    return actor[order], valid[order]


def _measured(
    actors: Actors,
    velocity_mps: Float64[np.ndarray, "actor step 2"],
    ego: int,
    rng: np.random.Generator,
) -> _Measured:
    """Add what a tracker errs: nothing about vehicles that stand, nor about itself."""
    count, steps = actors.present.shape
    speed_mps = np.linalg.norm(velocity_mps, axis=-1)
    walking = actors.kind == AgentType.PEDESTRIAN
    share = np.where(walking[:, None], 1.0, np.clip(speed_mps / _SURE_MPS, 0.0, 1.0))
    share[ego] = 0.0
    sway_m = np.where(walking, _SWAY_M, 0.0)[:, None]
    spread_m = np.where(walking, _WALKER_NOISE_M, _NOISE_M)[:, None]
    spread_rad = np.where(walking, _WALKER_NOISE_RAD, _NOISE_RAD)[:, None]
    pose = actors.pose.copy()
    for axis in (0, 1):
        pose[..., axis] += share * spread_m * wander(count, steps, _NOISE_S, rng)
        pose[..., axis] += sway_m * wander(count, steps, _SWAY_S, rng)
    pose[..., 2] += share * spread_rad * wander(count, steps, _NOISE_S, rng)
    noise_mps = share[..., None] * rng.normal(0.0, _NOISE_MPS, (count, steps, 2))
    return _Measured(pose, velocity_mps + noise_mps)


def _tracks(
    actors: Actors,
    measured: _Measured,
    kept: Int64[np.ndarray, " agent"],
    valid: Bool[np.ndarray, "agent step"],
    place: Place,
) -> tuple[Tracks, Float64[np.ndarray, "3"]]:
    """Write the tracks of the kept actors around the whole metres nearest to the ego."""
    pose = measured.pose[kept]
    size_lwh_m = _rounded(actors.size_lwh_m[kept], _GRID_M)
    xy_m = place.xy_m(pose[..., :2])
    z_m = place.ground_m(xy_m) + size_lwh_m[:, None, 2] / 2
    xyz_m = _rounded(np.concatenate([xy_m, z_m[..., None]], axis=-1), _GRID_M)
    heading_rad = wrap_angle(pose[..., 2] + place.turn_rad)
    turn_rad = np.full(valid.shape, place.turn_rad)
    velocity_mps = _rounded(rotate(measured.velocity_mps[kept], turn_rad), _GRID_MPS)
    origin_xyz_m = np.round(xyz_m[-1, NOW])
    # The record holds zeros where nothing was seen.
    world_m = np.where(valid[..., None], xyz_m, 0.0)
    return Tracks(
        id=np.arange(1, len(kept) + 1, dtype=np.int32),
        agent_type=actors.kind[kept].astype(np.int8),
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
