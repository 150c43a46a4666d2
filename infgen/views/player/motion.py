"""Tracks as runs of small whole numbers, and back.

A run is a stretch of steps without a gap. It is written as its first value and, for every
later step, by how much the difference to the step before has changed: centimetres and
milliradians are rounded first and subtracted afterwards, so errors do not add up.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int16, Int32

from infgen.geometry import wrap_angle

PER_M, PER_RAD = 100, 1000
"""Positions are kept to a centimetre, headings to a milliradian."""


class Runs(NamedTuple):
    """Tracks without their gaps.

    Attributes:
        agent: Row of each run.
        step: Its first step.
        length: Its number of steps.
        start: Its first pose: x and y in centimetres, heading in milliradians.
        change: Of the steps of all runs end to end: second differences; 0 at first steps.
    """

    agent: Int16[np.ndarray, " run"]
    step: Int16[np.ndarray, " run"]
    length: Int16[np.ndarray, " run"]
    start: Int32[np.ndarray, "run 3"]
    change: Int32[np.ndarray, "value 3"]


def to_runs(
    pose: Float32[np.ndarray, "agent step 3"], valid: Bool[np.ndarray, "agent step"]
) -> Runs:
    """Write tracks as runs."""
    agent, step = np.nonzero(valid)
    begins = (np.diff(agent, prepend=-1) != 0) | (np.diff(step, prepend=-2) != 1)
    first = np.flatnonzero(begins)
    length = np.diff(first, append=len(agent))
    values = pose[agent, step].astype(np.float64)
    values[:, 2] = _unwrapped(values[:, 2], begins)
    whole = np.rint(values * [PER_M, PER_M, PER_RAD]).astype(np.int32)
    speed = np.diff(whole, axis=0, prepend=np.int32(0))
    speed[begins] = 0
    change = np.diff(speed, axis=0, prepend=np.int32(0))
    change[begins] = 0
    return Runs(
        agent=agent[first].astype(np.int16),
        step=step[first].astype(np.int16),
        length=length.astype(np.int16),
        start=whole[first],
        change=change,
    )


def from_runs(
    runs: Runs, num_agents: int, num_steps: int
) -> tuple[Float32[np.ndarray, "agent step 3"], Bool[np.ndarray, "agent step"]]:
    """Read tracks back: poses and validity."""
    pose = np.zeros((num_agents, num_steps, 3), np.float32)
    valid = np.zeros((num_agents, num_steps), bool)
    at = 0
    for agent, step, length, start in zip(
        runs.agent.tolist(),
        runs.step.tolist(),
        runs.length.tolist(),
        runs.start,
        strict=True,
    ):
        change = runs.change[at : at + length].astype(np.int64)
        whole = start + np.cumsum(np.cumsum(change, axis=0), axis=0)
        pose[agent, step : step + length] = whole / [PER_M, PER_M, PER_RAD]
        valid[agent, step : step + length] = True
        at += length
    pose[..., 2] = wrap_angle(pose[..., 2])
    return pose, valid


def _unwrapped(heading_rad: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Headings without jumps of whole turns within a run."""
    if not len(heading_rad):
        return heading_rad
    turn = wrap_angle(np.diff(heading_rad, prepend=heading_rad[:1]))
    turn[begins] = 0
    total = np.cumsum(turn)
    run = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    return heading_rad[first][run] + total - total[first][run]
