"""What an ego observes, in its own frame: itself, agents, map, signals and its route.

The ego frame has its origin at the middle of the ego's box, x ahead and y to the left.
Nothing depends on where the scene lies in the world or how it is turned. Shapes are fixed:
of everything the nearest are observed, nearest first, and a mask tells how many there are.
Values are cut off at the bounds of their space.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float32, Float64, Int64

from infgen.environment.ego import MAX_SPEED_MPS, EgoState
from infgen.environment.route import Route
from infgen.environment.scenes import DrivingScene
from infgen.environment.settings import EnvironmentSettings
from infgen.environment.world import Agents
from infgen.geometry import rotate, to_local
from infgen.rollout.population import EGO_ROW
from infgen.scene import AgentType
from infgen.tokens.map import PolylineType
from infgen.tokens.scene_tokens import SignalClass

EGO = (
    "speed_mps",
    "accel_mps2",
    "steering_rad",
    "yaw_rate_rad_s",
    "length_m",
    "width_m",
    "route_left_m",
    "route_heading_cos",
    "route_heading_sin",
)
"""Columns of ``ego``: state and box, where the route is beside it, and its direction."""
AGENT_TYPES = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)
PLACE = ("x_m", "y_m", "heading_cos", "heading_sin")
AGENTS = (
    *PLACE,
    "velocity_x_mps",
    "velocity_y_mps",
    "length_m",
    "width_m",
    *(f"is_{agent_type.name.lower()}" for agent_type in AGENT_TYPES),
)
"""Columns of ``agents``. Velocities are over ground, along the axes of the ego frame."""
MAP = (*PLACE, *(f"is_{line.name.lower()}" for line in PolylineType))
"""Columns of ``map``: where each map token begins, its direction and its polyline type."""
SIGNALS = (*PLACE, *(f"is_{shown.name.lower()}" for shown in SignalClass))
"""Columns of ``signals``: where lanes with a signal begin, and what it shows."""
ROUTE = ("x_m", "y_m")
"""Columns of ``route``: points ahead on the route."""
ROUTE_SPACING_M = 5.0
FAST_MPS = 60.0
LONG_M = 30.0

Observation = dict[str, np.ndarray]


def table_spaces(settings: EnvironmentSettings) -> dict[str, spaces.Space[Any]]:
    """Return the space of each table that one environment observes."""
    far_m = settings.radius_m
    tables = {
        "agents": (settings.num_agents, AGENTS),
        "map": (settings.num_map_tokens, MAP),
        "signals": (settings.num_signals, SIGNALS),
    }
    found: dict[str, spaces.Space[Any]] = {"ego": _box((), EGO, far_m)}
    for name, (rows, columns) in tables.items():
        found[name] = _box((rows,), columns, far_m)
        found[f"{name}_mask"] = spaces.MultiBinary(rows)
    # A route is seen a little farther than anything else: its points are a fixed number.
    route_m = max(far_m, ROUTE_SPACING_M * (settings.num_route_points + 1))
    found["route"] = _box((settings.num_route_points,), ROUTE, route_m)
    return dict(sorted(found.items()))


def _box(rows: tuple[int, ...], columns: Sequence[str], far_m: float) -> spaces.Box:
    """Return the space of a table by the units of its columns."""
    high = np.array([_limit(name, far_m) for name in columns], dtype=np.float32)
    low = np.array(
        [0.0 if _is_positive(name) else -_limit(name, far_m) for name in columns],
        dtype=np.float32,
    )
    shape = (*rows, len(columns))
    return spaces.Box(np.broadcast_to(low, shape), np.broadcast_to(high, shape))


def _limit(name: str, far_m: float) -> float:
    if name.startswith("is_") or name.endswith(("_cos", "_sin")):
        return 1.0
    if name in ("length_m", "width_m"):
        return LONG_M
    by_unit = {
        "speed_mps": 2 * MAX_SPEED_MPS,
        "accel_mps2": 1000.0,
        "steering_rad": np.pi / 2,
        "yaw_rate_rad_s": 2 * np.pi,
        "velocity_x_mps": FAST_MPS,
        "velocity_y_mps": FAST_MPS,
    }
    return by_unit.get(name, far_m)


def _is_positive(name: str) -> bool:
    return name.startswith("is_") or name in ("length_m", "width_m", "speed_mps")


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What there is to observe in a batch of environments.

    Attributes:
        ego: The driven cars.
        agents: All agents.
        scenes: Scene of each environment.
        own_token: Last whole token step of each.
        routes: Route of each.
        along_m: How far along it the ego is.
    """

    ego: EgoState
    agents: Agents
    scenes: Sequence[DrivingScene]
    own_token: Int64[np.ndarray, " environment"]
    routes: Sequence[Route]
    along_m: Float64[np.ndarray, " environment"]


def observe(around: Surroundings, settings: EnvironmentSettings) -> Observation:
    """Return the observations of a batch of environments, by the names of their space."""
    agents, agents_mask = _agents(around, settings)
    found = {"ego": _ego(around), "agents": agents, "agents_mask": agents_mask}
    parts: dict[str, list[np.ndarray]] = {
        name: [] for name in ("map", "map_mask", "signals", "signals_mask", "route")
    }
    for at, scene in enumerate(around.scenes):
        pose = around.ego.pose[at]
        lines = _lines(scene, pose, settings)
        signals = _signals(scene, pose, int(around.own_token[at]), settings)
        for name, value in zip(parts, (*lines, *signals), strict=False):
            parts[name].append(value)
        parts["route"].append(_route(around, at, settings))
    found |= {name: np.stack(values) for name, values in parts.items()}
    return {
        name: _cut_off(found[name], space) for name, space in table_spaces(settings).items()
    }


def _cut_off(values: np.ndarray, space: spaces.Space[Any]) -> np.ndarray:
    if isinstance(space, spaces.Box):
        return np.clip(values, space.low, space.high).astype(np.float32)
    return values.astype(np.int8)


def _ego(around: Surroundings) -> np.ndarray:
    ego, size_m = around.ego, around.agents.size_lwh_m[:, EGO_ROW]
    ways_m = around.along_m[:, None] + np.array([0.0, 2.0])
    line = np.stack([r.at(w) for r, w in zip(around.routes, ways_m, strict=True)])
    line = _to_ego(line, ego.pose[:, None])
    way = line[:, 1] - line[:, 0]
    length_m = np.linalg.norm(way, axis=1, keepdims=True)
    # The end of a route has no direction: that of the ego counts.
    direction = np.where(length_m > 1e-6, way / np.maximum(length_m, 1e-6), [[1.0, 0.0]])
    return np.column_stack(
        [
            ego.speed_mps,
            ego.accel_mps2,
            ego.steering_rad,
            ego.yaw_rate_rad_s,
            size_m[:, :2],
            line[:, 0, 1],
            direction,
        ]
    )


def _agents(
    around: Surroundings, settings: EnvironmentSettings
) -> tuple[Float64[np.ndarray, "environment near column"], np.ndarray]:
    """Return the nearest agents but the ego, and which of them there are."""
    agents, count = around.agents, settings.num_agents
    frame = around.ego.pose[:, None]
    pose = to_local(agents.pose.astype(np.float64), frame)
    there = agents.there.copy()
    there[:, EGO_ROW] = False
    rows, near = _nearest(pose[..., :2], there, settings.radius_m, count)
    environment = np.arange(len(rows))[:, None]
    place, agent_type = pose[environment, rows], agents.agent_type[environment, rows]
    velocity = agents.velocity_mps[environment, rows].astype(np.float64)
    columns = [
        *_place(place),
        *np.moveaxis(rotate(velocity, -frame[..., 2]), -1, 0),
        *np.moveaxis(agents.size_lwh_m[environment, rows, :2], -1, 0),
        *(agent_type == each for each in AGENT_TYPES),
    ]
    return np.stack(columns, axis=-1) * near[..., None], near


def _lines(
    scene: DrivingScene, pose: Float64[np.ndarray, "3"], settings: EnvironmentSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest map tokens of one environment, and which of them there are."""
    if not len(scene.map_pose):
        return _nothing(settings.num_map_tokens, MAP)
    rows, near, place = _nearest_places(
        scene.map_pose, pose, settings.radius_m, settings.num_map_tokens
    )
    kinds = [line_type == scene.map_type[rows] for line_type in PolylineType]
    return np.stack([*_place(place), *kinds], axis=-1) * near[:, None], near


def _signals(
    scene: DrivingScene,
    pose: Float64[np.ndarray, "3"],
    token: int,
    settings: EnvironmentSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest stop lines of one environment, and which of them there are."""
    if not len(scene.line_pose):
        return _nothing(settings.num_signals, SIGNALS)
    rows, near, place = _nearest_places(
        scene.line_pose, pose, settings.radius_m, settings.num_signals
    )
    shown = np.full(len(rows), SignalClass.NO_SIGNAL, dtype=np.int8)
    if scene.line_shown.size:
        shown = scene.line_shown[rows, min(token, scene.line_shown.shape[1] - 1)]
    states = [shown == state for state in SignalClass]
    return np.stack([*_place(place), *states], axis=-1) * near[:, None], near


def _route(around: Surroundings, at: int, settings: EnvironmentSettings) -> np.ndarray:
    """Return points ahead on the route of one environment; past its end its last point."""
    number = np.arange(1, settings.num_route_points + 1)
    points_m = around.routes[at].at(around.along_m[at] + ROUTE_SPACING_M * number)
    return _to_ego(points_m, around.ego.pose[at, None])


def _nearest_places(
    places: Float32[np.ndarray, "place 3"],
    pose: Float64[np.ndarray, "3"],
    radius_m: float,
    count: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the nearest poses, which of them there are, and where in the ego frame."""
    local = to_local(places.astype(np.float64), pose[None])
    everyone = np.ones((1, len(places)), dtype=bool)
    rows, near = _nearest(local[None, :, :2], everyone, radius_m, count)
    return rows[0], near[0], local[rows[0]]


def _nearest(
    xy_m: Float64[np.ndarray, "environment place 2"],
    there: Bool[np.ndarray, "environment place"],
    radius_m: float,
    count: int,
) -> tuple[Int64[np.ndarray, "environment near"], Bool[np.ndarray, "environment near"]]:
    """Number the nearest places within a radius, nearest first; rows of others are 0."""
    away_m = np.where(there, np.hypot(xy_m[..., 0], xy_m[..., 1]), np.inf)
    few = min(count, away_m.shape[1])
    rows = np.zeros((len(away_m), count), dtype=np.int64)
    found = np.argpartition(away_m, few - 1, axis=1)[:, :few]
    order = np.take_along_axis(away_m, found, axis=1).argsort(axis=1, kind="stable")
    rows[:, :few] = np.take_along_axis(found, order, axis=1)
    near = np.take_along_axis(away_m, rows, axis=1) <= radius_m
    near[:, few:] = False
    return np.where(near, rows, 0), near


def _nothing(count: int, columns: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((count, len(columns))), np.zeros(count, dtype=bool)


def _place(pose: Float64[np.ndarray, "*place 3"]) -> list[np.ndarray]:
    return [pose[..., 0], pose[..., 1], np.cos(pose[..., 2]), np.sin(pose[..., 2])]


def _to_ego(xy_m: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Bring points [..., 2] of the scene to the frame of ego poses [..., 3]."""
    return rotate(xy_m - pose[..., :2], -pose[..., 2])
