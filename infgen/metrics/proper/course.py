"""The course of a log or rollout: agents around the ego, entries and exits by window.

An agent enters in the window in which it is within the radius for the first time, unless it
is there now, and exits in that in which it is there for the last time. This needs neither
tokens nor insertions, so it is the same for any log and any simulator.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int64

from infgen.clock import CLOCK
from infgen.metrics.traffic import Traffic
from infgen.metrics.windows import Windows
from infgen.scene import AgentType

TYPES = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)
RINGS = 3
"""Rings of equal width around the ego in which agents are counted ..."""
EVENT_RINGS = 5
"""... and in which entries and exits are."""
UNSEEN_TOKENS = 2
"""In the last second an exit cannot be told from a gap in the track."""


@dataclass(frozen=True, slots=True)
class Course:
    """A few numbers per window; the ego is not counted.

    Attributes:
        now: Agents within the radius at the last step of the history, by type and ring.
        present: Mean number of agents in each window.
        entries: Entries by the ring in which the agent is first seen.
        exits: Exits by the ring in which it is last seen; NaN in windows of which the last
            second of the data is part.
    """

    now: Float32[np.ndarray, "type ring"]
    present: Float32[np.ndarray, "window type ring"]
    entries: Float32[np.ndarray, "window event_ring"]
    exits: Float32[np.ndarray, "window event_ring"]

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.exits)

    def cut(self, windows: int) -> "Course":
        """Keep the first windows."""
        return replace(
            self,
            present=self.present[:windows],
            entries=self.entries[:windows],
            exits=self.exits[:windows],
        )


def follow_course(traffic: Traffic, radius_m: float, windows: Windows) -> Course:
    """Count the agents around the ego in windows after now.

    Args:
        traffic: A log or a rollout; what lies beyond the last window does not count.
        radius_m: Agents nearer to the ego are around it.
        windows: Side by side, over the steps after now.
    """
    motion, now = traffic.motion, traffic.now
    stop = now + 1 + windows.count * windows.length * CLOCK.steps_per_token
    x_m, y_m = motion.x_m[0, :, :stop], motion.y_m[0, :, :stop]
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    near = motion.valid[0, :, :stop] & (away_m < radius_m)
    near[traffic.ego] = False
    ring = np.minimum(RINGS * away_m / radius_m, RINGS - 1).astype(np.int64)
    cells = _cells(near, ring, motion.agent_type)
    future = cells[..., now + 1 :].reshape(*cells.shape[:2], windows.count, -1)
    present = np.moveaxis(future.mean(axis=-1, dtype=np.float64), -1, 0)
    return Course(
        now=cells[..., now].astype(np.float32),
        present=present.astype(np.float32),
        entries=_entries(near, away_m / radius_m, now, windows.count),
        exits=_exits(near, away_m / radius_m, now, windows.count),
    )


def _cells(
    near: Bool[np.ndarray, "agent step"],
    ring: Int64[np.ndarray, "agent step"],
    agent_type: Int8[np.ndarray, " agent"],
) -> Int64[np.ndarray, "type ring step"]:
    """Count agents by type and ring at each step."""
    counts = [
        (near & (ring == at) & (agent_type == kind)[:, None]).sum(axis=0)
        for kind in TYPES
        for at in range(RINGS)
    ]
    return np.array(counts, dtype=np.int64).reshape(len(TYPES), RINGS, -1)


def _entries(
    near: Bool[np.ndarray, "agent step"], share: np.ndarray, now: int, windows: int
) -> Float32[np.ndarray, "window event_ring"]:
    """Count first steps within the radius by window and ring."""
    first = near.argmax(axis=1)
    (rows,) = np.nonzero(near.any(axis=1) & (first > now))
    return _count(first[rows] - now - 1, near, share[rows, first[rows]], now, windows)


def _exits(
    near: Bool[np.ndarray, "agent step"], share: np.ndarray, now: int, windows: int
) -> Float32[np.ndarray, "window event_ring"]:
    """Count last steps within the radius by window and ring."""
    after = near.shape[1] - now - 1
    last = near.shape[1] - 1 - near[:, ::-1].argmax(axis=1)
    unseen = UNSEEN_TOKENS * CLOCK.steps_per_token
    (rows,) = np.nonzero(near.any(axis=1) & (last >= now) & (last < near.shape[1] - unseen))
    # Whoever is last near now exits in the first window.
    step = np.maximum(last[rows] - now - 1, 0)
    counts = _count(step, near, share[rows, last[rows]], now, windows)
    ends = (np.arange(windows) + 1) * after // max(1, windows)
    counts[ends > after - unseen] = np.nan
    return counts


def _count(
    step: np.ndarray, near: np.ndarray, share: np.ndarray, now: int, windows: int
) -> Float32[np.ndarray, "window event_ring"]:
    """Count events by window, from steps after now, and ring, from shares of the radius."""
    counts = np.zeros((windows, EVENT_RINGS), dtype=np.float32)
    window = step * windows // max(1, near.shape[1] - now - 1)
    ring = np.minimum(EVENT_RINGS * share, EVENT_RINGS - 1).astype(np.int64)
    np.add.at(counts, (window, ring), 1)
    return counts
