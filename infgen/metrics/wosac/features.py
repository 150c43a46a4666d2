"""All features of the official metric, measured on the log or on rollouts."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from infgen.metrics.interaction import nearest_object_m, time_to_collision_s
from infgen.metrics.kinematics import measure_kinematics
from infgen.metrics.motion import Motion
from infgen.metrics.road import road_edge_m
from infgen.metrics.wosac.logged import LoggedScene
from infgen.metrics.wosac.signals import build_stop_lines, runs_red_light
from infgen.scene import AgentType
from infgen.spatial.road_edges import RoadError, build_road_edges

LIGHTS = "traffic_light_violation"
NEED_EDGES = ("distance_to_road_edge", "offroad_indication")
"""Features that are not measured without road edges."""


@dataclass(frozen=True, slots=True)
class Features:
    """Features of the evaluated objects, under the official names.

    Attributes:
        linear_speed: Metres per second, in space; NaN at the log's ends.
        linear_acceleration: Change of the speed.
        angular_speed: Radians per second.
        angular_acceleration: Change of the turning speed.
        distance_to_nearest_object: Metres, negative inside another.
        time_to_collision: Seconds, at most five.
        distance_to_road_edge: Metres, positive off-road.
        traffic_light_violation: Crossing a red light's stop line.
        average_displacement_error: Mean distance to the log over its observed steps.
        valid: Whether the object is there at a scored step.
        vehicle: Whether the object is a vehicle.
        not_measured: Names of features, events among them, that the log does not tell:
            values without meaning.
    """

    linear_speed: Float32[np.ndarray, "rollout object step"]
    linear_acceleration: Float32[np.ndarray, "rollout object step"]
    angular_speed: Float32[np.ndarray, "rollout object step"]
    angular_acceleration: Float32[np.ndarray, "rollout object step"]
    distance_to_nearest_object: Float32[np.ndarray, "rollout object step"]
    time_to_collision: Float32[np.ndarray, "rollout object step"]
    distance_to_road_edge: Float32[np.ndarray, "rollout object step"]
    traffic_light_violation: Bool[np.ndarray, "rollout object step"]
    average_displacement_error: Float32[np.ndarray, "rollout object"]
    valid: Bool[np.ndarray, "rollout object step"]
    vehicle: Bool[np.ndarray, " object"]
    not_measured: frozenset[str] = frozenset()

    @property
    def collision_indication(self) -> Bool[np.ndarray, "rollout object step"]:
        """Whether boxes overlap."""
        return self.distance_to_nearest_object < 0

    @property
    def offroad_indication(self) -> Bool[np.ndarray, "rollout object step"]:
        """Whether a corner is beyond a road edge."""
        return self.distance_to_road_edge > 0


def measure(
    log: LoggedScene, motion: Motion, evaluated: np.ndarray, steps: slice
) -> Features:
    """Measure evaluated objects at some steps of 91; steps around them take part."""
    kinematics = measure_kinematics(
        motion.x_m[:, evaluated],
        motion.y_m[:, evaluated],
        motion.z_m[:, evaluated],
        motion.heading_rad[:, evaluated],
    )
    edge_m = _road_edge_m(log, motion, evaluated, steps)
    not_measured = [
        *(() if log.lights_recorded else (LIGHTS,)),
        *(() if edge_m is not None else NEED_EDGES),
    ]
    if edge_m is None:
        shape = motion.valid[:, evaluated, steps].shape
        edge_m = np.full(shape, np.nan, dtype=np.float32)
    return Features(
        linear_speed=kinematics.speed_mps[..., steps],
        linear_acceleration=kinematics.accel_mps2[..., steps],
        angular_speed=kinematics.yaw_rate_rad_s[..., steps],
        angular_acceleration=kinematics.yaw_accel_rad_s2[..., steps],
        distance_to_nearest_object=nearest_object_m(motion, evaluated, steps),
        time_to_collision=time_to_collision_s(motion, evaluated, steps),
        distance_to_road_edge=edge_m,
        traffic_light_violation=_red_lights(log, motion, evaluated)[..., steps],
        average_displacement_error=_displacement_m(log.motion, motion, evaluated),
        valid=motion.valid[:, evaluated, steps],
        vehicle=motion.agent_type[evaluated] == AgentType.VEHICLE,
        not_measured=frozenset(not_measured),
    )


def concatenate(parts: Sequence[Features]) -> Features:
    """Join features of the same objects, rollout after rollout."""
    shared = {name: getattr(parts[0], name) for name in ("vehicle", "not_measured")}
    names = [field.name for field in fields(Features) if field.name not in shared]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return Features(**joined, **shared)


def _road_edge_m(
    log: LoggedScene, motion: Motion, evaluated: np.ndarray, steps: slice
) -> Float32[np.ndarray, "rollout object step"] | None:
    """Distance to the nearest road edge; None where the map has none."""
    try:
        edges = build_road_edges(log.edges())
    except RoadError:
        return None
    return road_edge_m(motion, evaluated, steps, edges)


def _red_lights(
    log: LoggedScene, motion: Motion, evaluated: np.ndarray
) -> Bool[np.ndarray, "rollout object step"]:
    lines = build_stop_lines(
        log.lane_id, log.lanes(), log.signal_lane_id, log.signal_state, log.signal_stop_m
    )
    return runs_red_light(motion, evaluated, lines)


def _displacement_m(
    log: Motion, motion: Motion, evaluated: np.ndarray
) -> Float32[np.ndarray, "rollout object"]:
    """Mean distance in space to the log over its observed steps, history included."""
    valid = log.valid[:, evaluated]
    squares = sum(
        (one[:, evaluated] - other[:, evaluated]) ** 2
        for one, other in (
            (motion.x_m, log.x_m),
            (motion.y_m, log.y_m),
            (motion.z_m, log.z_m),
        )
    )
    gap_m = np.where(valid, np.sqrt(squares), np.float32(0))
    return gap_m.sum(axis=-1) / valid.sum(axis=-1, dtype=np.float32)
