"""Entries and exits by distance, for models that neither insert nor remove (SPEC 7.1)."""

from dataclasses import replace

import numpy as np

from infgen.clock import CLOCK
from infgen.rollout.rollout import NEVER, Rollout


def present_within_radius(rollout: Rollout, radius_m: float) -> Rollout:
    """Let agents enter and leave a rollout by crossing a circle around the ego.

    Distances are read at the ends of token steps. An agent enters where it is within the
    radius for the first time and never was before; it leaves where it is beyond it for the
    first time and always was within before. Agents beyond it are absent.

    Args:
        rollout: A rollout without insertion and removal.
        radius_m: Tuned on validation to make placement scores best (SPEC 7.1).
    """
    away_m = rollout.xyz_m[..., :2] - rollout.xyz_m[rollout.ego, :, :2]
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])
    within = rollout.valid & (distance_m <= radius_m)  # [agent, step]
    ends = np.arange(rollout.now, rollout.num_steps, CLOCK.steps_per_token)
    near = within[:, ends]
    later = np.arange(len(ends)) > 0
    ever_near = np.maximum.accumulate(near, axis=1)
    always_near = np.minimum.accumulate(near, axis=1)
    enters = near & later & ~_before(ever_near, first=False)
    leaves = ~near & later & _before(always_near, first=True)

    entry_step = np.where(
        enters.any(axis=1), ends[enters.argmax(axis=1)], rollout.entry_step
    )
    valid = within & ~(
        enters.any(axis=1)[:, None] & (np.arange(rollout.num_steps) <= entry_step[:, None])
    )
    outside = np.where(leaves.any(axis=1), ends[leaves.argmax(axis=1)], rollout.num_steps)
    before_exit = valid & (np.arange(rollout.num_steps) < outside[:, None])
    last = rollout.num_steps - 1 - before_exit[:, ::-1].argmax(axis=1)
    exit_step = np.where(leaves.any(axis=1) & before_exit.any(axis=1), last, NEVER)
    return replace(
        rollout,
        valid=valid,
        xyz_m=rollout.xyz_m * valid[..., None],
        heading_rad=rollout.heading_rad * valid,
        entry_step=entry_step.astype(np.int16),
        exit_step=exit_step.astype(np.int16),
    )


def _before(values: np.ndarray, *, first: bool) -> np.ndarray:
    """Values [agent, end] of the end before, ``first`` before the first."""
    start = np.full((len(values), 1), first)
    return np.concatenate([start, values[:, :-1]], axis=1)
