"""Who comes after now, from when it is near: how fast, where from, what it is, on whom.

Part of ``traffic_drift.py``: logs and rollouts are measured by the same code.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from infgen.clock import CLOCK
from infgen.metrics.interaction import nearest_object_m
from infgen.metrics.long_term.reference import divergence_bits
from infgen.metrics.road import road_edge_m
from infgen.metrics.traffic import Traffic
from infgen.scene import AgentType
from infgen.spatial.road_edges import RoadEdges

STEPS_PER_S = round(1 / CLOCK.step_s)
SPEED_EDGES_MPS = np.arange(0.0, 26.0)
"""Bins of first speeds; what is faster is in the last one."""
STANDING_MPS = 0.5
"""Who is slower in the first second stands."""
BEARINGS = 8
"""Sectors that inserted agents come from; the first is straight ahead of the ego."""


@dataclass(slots=True)
class InsertedSample:
    """All inserted agents of some logs or rollouts, one entry for each part of it.

    Attributes:
        first_mps: Speeds in the first second; of whoever is seen in it.
        off_road: Whether vehicles are off the road when first near.
        overlaps: Whether who is first near overlaps somebody there.
        bearing_rad: Where from, as the ego sees it: 0 is ahead, left is positive.
        agent_type: ``AgentType``.
    """

    first_mps: list[Float64[np.ndarray, " agent"]] = field(default_factory=list)
    off_road: list[Bool[np.ndarray, " agent"]] = field(default_factory=list)
    overlaps: list[Bool[np.ndarray, " agent"]] = field(default_factory=list)
    bearing_rad: list[Float32[np.ndarray, " agent"]] = field(default_factory=list)
    agent_type: list[Int64[np.ndarray, " agent"]] = field(default_factory=list)

    def take(
        self,
        traffic: Traffic,
        edges: RoadEdges | None,
        speed_mps: np.ndarray,
        known: np.ndarray,
        near: np.ndarray,
    ) -> None:
        """Measure the inserted agents of one log or rollout that are near for a second.

        Args:
            traffic: Logged or played.
            edges: Of the map's roads, if it has any.
            speed_mps: Of everybody [agent, step].
            known: Where speeds are known [agent, step].
            near: Who is within the radius [agent, step].
        """
        motion = traffic.motion
        late = motion.valid[0].argmax(axis=1) > traffic.now
        first = near.argmax(axis=1)
        rows = np.flatnonzero(near.any(axis=1) & late)
        rows = rows[first[rows] + STEPS_PER_S < near.shape[1]]
        if not len(rows):
            return
        second = first[rows, None] + np.arange(1, STEPS_PER_S)
        there = (near & known)[rows[:, None], second]
        mps = np.where(there, speed_mps[rows[:, None], second], 0.0).sum(axis=1)
        seen = there.any(axis=1)
        mean_mps = mps / np.maximum(there.sum(axis=1), 1)
        self.first_mps.append(mean_mps[seen].astype(float))
        self.agent_type.append(motion.agent_type[rows].astype(np.int64))
        self.bearing_rad.append(_bearing_rad(traffic, rows, first[rows]))
        self.overlaps.append(_overlaps_at(traffic, rows, first[rows]))
        vehicles = rows[motion.agent_type[rows] == AgentType.VEHICLE]
        if edges is not None and len(vehicles):
            self.off_road.append(_off_at(traffic, vehicles, first[vehicles], edges))

    def numbers(self) -> dict[str, float | None]:
        """Return their figures; only how many were seen (0) if there are none."""
        mps, off = _joined(self.first_mps), _joined(self.off_road)
        agent_type, overlaps = _joined(self.agent_type), _joined(self.overlaps)
        if not len(mps):
            return {"seen": 0.0}
        return {
            "seen": float(len(mps)),
            "standing (< 0.5 m/s)": float((mps < STANDING_MPS).mean()),
            "median m/s": float(np.median(mps)),
            "90 % m/s": float(np.percentile(mps, 90)),
            "vehicles off-road": float(off.mean()) if len(off) else None,
            "overlap another": float(overlaps.mean()),
            "pedestrians": float((agent_type == AgentType.PEDESTRIAN).mean()),
            "cyclists": float((agent_type == AgentType.CYCLIST).mean()),
        }

    def speed_counts(self) -> Float64[np.ndarray, " bin"]:
        """Count inserted agents by their speed in the first second."""
        mps = np.minimum(_joined(self.first_mps), SPEED_EDGES_MPS[-1])
        return np.histogram(mps, SPEED_EDGES_MPS)[0].astype(np.float64)

    def bearing_counts(self) -> Float64[np.ndarray, " sector"]:
        """Count inserted agents by the sector of the ego's surroundings they come from."""
        width_rad = 2 * np.pi / BEARINGS
        sector = np.rint(_joined(self.bearing_rad) / width_rad).astype(int) % BEARINGS
        return np.bincount(sector, minlength=BEARINGS).astype(np.float64)


def apart_bits(logs: InsertedSample, played: InsertedSample) -> dict[str, float]:
    """Jensen-Shannon divergences of first speeds and of bearings, in bits; NaN if none."""
    speeds = divergence_bits(logs.speed_counts(), played.speed_counts())
    bearings = divergence_bits(logs.bearing_counts(), played.bearing_counts())
    return {"first_speed_js": float(speeds), "bearing_js": float(bearings)}


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.empty(0)


def _bearing_rad(
    traffic: Traffic, rows: Int64[np.ndarray, " agent"], steps: np.ndarray
) -> Float32[np.ndarray, " agent"]:
    motion, ego = traffic.motion, traffic.ego
    x_m, y_m = motion.x_m[0], motion.y_m[0]
    towards_rad = np.arctan2(
        y_m[rows, steps] - y_m[ego, steps], x_m[rows, steps] - x_m[ego, steps]
    )
    return towards_rad - motion.heading_rad[0, ego, steps]


def _overlaps_at(
    traffic: Traffic, rows: Int64[np.ndarray, " agent"], steps: np.ndarray
) -> Bool[np.ndarray, " agent"]:
    """Whether the box of each overlaps another at a step of its own."""
    found = np.zeros(len(rows), bool)
    for step in np.unique(steps):
        here = steps == step
        gap_m = nearest_object_m(traffic.motion, rows[here], slice(step, step + 1))
        found[here] = gap_m[0, :, 0] < 0
    return found


def _off_at(
    traffic: Traffic,
    rows: Int64[np.ndarray, " agent"],
    steps: np.ndarray,
    edges: RoadEdges,
) -> Bool[np.ndarray, " agent"]:
    """Whether each of some vehicles is off the road at a step of its own."""
    found = np.zeros(len(rows), bool)
    for step in np.unique(steps):
        here = steps == step
        off_m = road_edge_m(traffic.motion, rows[here], slice(step, step + 1), edges)
        found[here] = off_m[0, :, 0] > 0
    return found
