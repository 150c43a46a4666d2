"""Traffic as bins: every feature of every agent at every step, small enough to keep.

A score follows from bins alone once the log-probability of each bin is known, so traffic is
measured once, before the whole split has been read.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

from infgen.metrics.interaction import nearest_object_m, time_to_collision_s
from infgen.metrics.kinematics import measure_kinematics, speed_valid
from infgen.metrics.likelihood import bin_of
from infgen.metrics.long_term.protocols import (
    PROTOCOLS,
    STEP_FEATURES,
    Feature,
    Protocol,
    simulated_boxes,
)
from infgen.metrics.road import road_edge_m
from infgen.metrics.traffic import Traffic, with_boxes
from infgen.spatial.road_edges import RoadEdges

NO_BIN = 255
"""Where an agent has no value: not there, or left out."""


@dataclass(frozen=True, slots=True)
class Binned:
    """One log or rollout after now, in bins.

    Attributes:
        scenario_id: Id of the log.
        index: Which rollout; ``traffic.LOGGED`` for the log.
        there_now: Agents present at the last step of the history.
        bins: Bin of each of ``STEP_FEATURES``, or ``NO_BIN``, by protocol.
        entry_token: As in ``placement.Events``.
        entry_distance_m: As in ``placement.Events``.
        exit_token: As in ``placement.Events``.
        exit_distance_m: As in ``placement.Events``.
        num_near: Agents within the count radius of the ego, the ego not counted.
        num_all: Agents at any distance, the ego not counted.
    """

    scenario_id: str
    index: int
    there_now: Bool[np.ndarray, " agent"]
    bins: UInt8[np.ndarray, "protocol feature agent step"]
    entry_token: Int16[np.ndarray, " entry"]
    entry_distance_m: Float32[np.ndarray, " entry"]
    exit_token: Int16[np.ndarray, " exit"]
    exit_distance_m: Float32[np.ndarray, " exit"]
    num_near: Int16[np.ndarray, " step"]
    num_all: Int16[np.ndarray, " step"]


def bin_traffic(
    traffic: Traffic, edges: RoadEdges | None, count_radius_m: float, *, as_logged: bool
) -> Binned:
    """Measure traffic after now and put it in bins.

    Args:
        traffic: A log or a rollout.
        edges: Road edges; without any, the map features have no values.
        count_radius_m: Agents nearer to the ego count as near.
        as_logged: Keep true boxes under every protocol; otherwise treat it as simulated.
    """
    own = traffic.motion.size_lwh_m
    measured: dict[bytes, list[tuple[np.ndarray, np.ndarray]]] = {}
    bins = []
    for protocol in PROTOCOLS:
        boxes = (
            own if as_logged else simulated_boxes(protocol, traffic.motion.agent_type, own)
        )
        key = boxes.tobytes()
        if key not in measured:
            measured[key] = _measure(with_boxes(traffic, boxes), edges)
        bins.append(
            [
                _bin(values, valid, feature, protocol)
                for (values, valid), feature in zip(
                    measured[key], STEP_FEATURES, strict=True
                )
            ]
        )
    num_near, num_all = _count_agents(traffic, count_radius_m)
    return Binned(
        scenario_id=traffic.scenario_id,
        index=traffic.index,
        there_now=traffic.there_now,
        bins=np.array(bins, dtype=np.uint8),
        entry_token=traffic.events.entry_token,
        entry_distance_m=traffic.events.entry_distance_m,
        exit_token=traffic.events.exit_token,
        exit_distance_m=traffic.events.exit_distance_m,
        num_near=num_near,
        num_all=num_all,
    )


def _measure(
    traffic: Traffic, edges: RoadEdges | None
) -> list[tuple[Float32[np.ndarray, "agent step"], Bool[np.ndarray, "agent step"]]]:
    """Values of ``STEP_FEATURES`` in their order, and where they count."""
    motion, steps = traffic.motion, traffic.future
    every = np.arange(motion.num_agents)
    kinematics = measure_kinematics(motion.x_m, motion.y_m, motion.z_m, motion.heading_rad)
    valid = motion.valid[0]
    moving = speed_valid(valid)
    changing = speed_valid(moving)
    there = valid[:, steps]
    nearest_m = nearest_object_m(motion, every, steps)[0]
    ttc_s = time_to_collision_s(motion, every, steps)[0]
    edge_m, on_map = np.zeros_like(nearest_m), np.zeros_like(there)
    if edges is not None:
        edge_m, on_map = road_edge_m(motion, every, steps, edges)[0], there
    return [
        (kinematics.speed_mps[0, :, steps], moving[:, steps]),
        (kinematics.accel_mps2[0, :, steps], changing[:, steps]),
        (kinematics.yaw_rate_rad_s[0, :, steps], moving[:, steps]),
        (kinematics.yaw_accel_rad_s2[0, :, steps], changing[:, steps]),
        (nearest_m, there),
        ((nearest_m < 0).astype(np.float32), there),
        (ttc_s, there),
        (edge_m, on_map),
        ((edge_m > 0).astype(np.float32), on_map),
    ]


def _bin(
    values: Float32[np.ndarray, "agent step"],
    valid: Bool[np.ndarray, "agent step"],
    feature: Feature,
    protocol: Protocol,
) -> UInt8[np.ndarray, "agent step"]:
    counts = valid & in_range(values, feature, protocol)
    return np.where(counts, bin_of(values, feature.histogram), NO_BIN).astype(np.uint8)


def in_range(
    values: Float32[np.ndarray, "..."], feature: Feature, protocol: Protocol
) -> Bool[np.ndarray, "..."]:
    """Which values a protocol counts; NaN never does."""
    if protocol.keep_ends or not feature.is_distance:
        return ~np.isnan(values)
    low, high = feature.histogram.low, feature.histogram.high
    return (values > low) & (values < high)


def _count_agents(
    traffic: Traffic, radius_m: float
) -> tuple[Int16[np.ndarray, " step"], Int16[np.ndarray, " step"]]:
    """Count the agents at each step after now, within a radius of the ego and in all."""
    motion, steps, ego = traffic.motion, traffic.future, traffic.ego
    x_m, y_m = motion.x_m[0, :, steps], motion.y_m[0, :, steps]
    others = motion.valid[0, :, steps].copy()
    others[ego] = False
    near = others & (np.hypot(x_m - x_m[ego], y_m - y_m[ego]) <= radius_m)
    return near.sum(axis=0).astype(np.int16), others.sum(axis=0).astype(np.int16)
