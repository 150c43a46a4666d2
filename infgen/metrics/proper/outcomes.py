"""Outcomes of each agent at each step: the bin of a feature, or that it is gone.

Features and bins are those of the official metric, as the long-term metrics put them.
Agents are those that are there now; they keep their ids. That an agent is gone is an
outcome like any bin, so a street that empties is wrong wherever the log's does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int32, UInt8

from infgen.metrics.long_term.binned import NO_BIN, Binned
from infgen.metrics.long_term.protocols import CORRECTED, MAX_BINS, PROTOCOLS
from infgen.metrics.traffic import Traffic

GONE = MAX_BINS
"""Outcome of an agent that has left for good."""
UNKNOWN = NO_BIN
"""Outcome where nothing can be said, as in a gap of a track."""


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What happens to the agents that are there now.

    Attributes:
        id: Their track ids, ascending.
        outcome: Bin of each of ``STEP_FEATURES``, ``GONE`` or ``UNKNOWN``.
    """

    id: Int32[np.ndarray, " agent"]
    outcome: UInt8[np.ndarray, "feature agent step"]


def read_outcomes(
    traffic: Traffic,
    binned: Binned,
    ids: Int32[np.ndarray, " agent"],
    num_steps: int,
    radius_m: float = np.inf,
) -> Outcomes:
    """Read the outcomes of a log or a rollout at the first steps after now.

    Args:
        traffic: The log or rollout.
        binned: The same in bins, with boxes of its own.
        ids: Track ids of all its agents.
        num_steps: How many steps.
        radius_m: Agents that are farther from the ego now are left out.
    """
    x_m, y_m = traffic.motion.x_m[0, :, traffic.now], traffic.motion.y_m[0, :, traffic.now]
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    rows = np.flatnonzero(traffic.there_now & (away_m < radius_m))
    rows = rows[np.argsort(ids[rows], kind="stable")]
    every = binned.bins[PROTOCOLS.index(CORRECTED)]
    # A map feature without a map has no outcomes, not even that agents are gone.
    measured = (every != NO_BIN).any(axis=(1, 2))[:, None, None]
    bins = every[:, rows, :num_steps]
    first = traffic.now + 1
    seen = traffic.motion.valid[0, rows, first : first + num_steps]
    gone = _gone(seen) & (bins == NO_BIN) & measured
    outcome = np.where(gone, np.uint8(GONE), bins)
    return Outcomes(ids[rows], outcome)


def align(
    logged: Outcomes, members: Sequence[Outcomes]
) -> UInt8[np.ndarray, "member feature agent step"]:
    """Bring the outcomes of rollouts to the agents of the log.

    An agent that a rollout does not have is gone in it. What cannot be said of the log, in
    a gap of its track, is not asked of rollouts.
    """
    aligned = np.full((len(members), *logged.outcome.shape), GONE, dtype=np.uint8)
    for row, one in zip(aligned, members, strict=True):
        rows = np.flatnonzero(np.isin(logged.id, one.id))
        row[:, rows] = one.outcome[:, np.searchsorted(one.id, logged.id[rows])]
    return np.where(logged.outcome == UNKNOWN, np.uint8(UNKNOWN), aligned)


def _gone(seen: Bool[np.ndarray, "agent step"]) -> Bool[np.ndarray, "agent step"]:
    """Whether an agent is seen neither at a step nor later."""
    return ~np.maximum.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
