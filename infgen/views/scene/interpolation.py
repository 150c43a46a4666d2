"""Where everyone is at any time: between two steps agents go straight, as in the player."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64

from infgen.geometry import wrap_angle
from infgen.views.scene.style import AGENTS
from infgen.views.scene.view_model import Showing


class Moment(NamedTuple):
    """Everyone at one time.

    Attributes:
        pose: x, y, heading.
        alpha: Opacity; 0 for whoever is not to be seen.
        ghost: Whether the agent has left just now: only its outline is drawn.
    """

    pose: Float32[np.ndarray, "agent 3"]
    alpha: Float64[np.ndarray, " agent"]
    ghost: Bool[np.ndarray, " agent"]


def moment_at(showing: Showing, time: float) -> Moment:
    """Find where everyone is.

    Args:
        showing: The log, or a rollout.
        time: In steps from the first, whole or not; after the last all stand still.
    """
    steps, last = showing.num_steps, showing.last_step.astype(np.int64)
    step = min(int(time), steps - 1)
    following = min(step + 1, steps - 1)
    rows = np.arange(len(last))
    there = showing.valid[:, step]
    goes_on = there & showing.valid[:, following]
    share = np.where(goes_on, min(time - step, 1.0), 0.0).astype(np.float32)
    left = last < steps
    ghost = left & ~there & (time >= last) & (time - last <= AGENTS.ghost_steps)
    at = np.where(ghost, np.minimum(last, steps - 1), step)
    pose, ahead = showing.pose[rows, at], showing.pose[rows, np.minimum(at + 1, steps - 1)]
    turn = np.concatenate(
        [ahead[:, :2] - pose[:, :2], wrap_angle(ahead[:, 2:] - pose[:, 2:])], axis=1
    )
    alpha = np.where(left, _fade(last - time), 1.0)
    alpha *= np.where(showing.first_step > 0, _arrival(time - showing.first_step), 1.0)
    gone = AGENTS.leaving_alpha * (1 - (time - last) / AGENTS.ghost_steps)
    return Moment(
        pose=pose + share[:, None] * turn,
        alpha=np.where(there, alpha, np.where(ghost, gone, 0.0)),
        ghost=ghost,
    )


def ego_place(showing: Showing, time: float) -> Float32[np.ndarray, "2"]:
    """Where the ego is, or was when last seen."""
    step = min(int(time), showing.num_steps - 1)
    seen = np.flatnonzero(showing.valid[showing.ego, : step + 1])
    if len(seen) and seen[-1] == step:
        return moment_at(showing, time).pose[showing.ego, :2]
    last = int(seen[-1]) if len(seen) else int(showing.first_step[showing.ego])
    return showing.pose[showing.ego, last, :2]


def _fade(steps_left: np.ndarray) -> np.ndarray:
    share = np.clip(steps_left / AGENTS.fade_steps, 0, 1)
    return AGENTS.leaving_alpha + (1 - AGENTS.leaving_alpha) * share


def _arrival(since: np.ndarray) -> np.ndarray:
    return np.minimum(1.0, AGENTS.arrive_alpha + since / AGENTS.arrive_steps)
