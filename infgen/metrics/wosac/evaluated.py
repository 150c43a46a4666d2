"""Who is evaluated where the record names no tracks to predict, as other sources do not.

WOMD names up to eight tracks of each scene that are hard to predict; the official metric
evaluates them and the recording car. Other sources are scored alike: of the road users seen
now and long after, the one of each type that moves farthest, and then any other.
"""

import numpy as np
from jaxtyping import Int32

from infgen.scene import AgentType, Tracks

MAX_EVALUATED = 8
"""Beside the recording car, as many as WOMD names."""
SEEN_SHARE = 0.6
"""Of the steps after now, at which an agent must be seen."""


def choose_evaluated(tracks: Tracks, ego: int, steps: slice) -> Int32[np.ndarray, " row"]:
    """Choose agents to evaluate beside the recording car.

    Args:
        tracks: The logged agents.
        ego: Row of the recording car.
        steps: Now, and the steps after it that are scored.

    Returns:
        Their rows, ascending.
    """
    valid = tracks.valid[:, steps]
    able = valid[:, 0] & (valid[:, 1:].mean(axis=1) > SEEN_SHARE)
    able &= (tracks.agent_type >= 0) & (tracks.agent_type < AgentType.OTHER)
    able[ego] = False
    rows = np.flatnonzero(able)
    moved_m = _moved_m(tracks.xyz_m[rows, steps, :2], valid[rows])
    rows = rows[np.argsort(-moved_m, kind="stable")]
    _, first = np.unique(tracks.agent_type[rows], return_index=True)
    chosen = np.append(rows[first], np.delete(rows, first))[:MAX_EVALUATED]
    return np.sort(chosen).astype(np.int32)


def _moved_m(xy_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Distance [agent] between the first and the last step at which each is seen."""
    last = valid.shape[1] - 1 - valid[:, ::-1].argmax(axis=1)
    ends_m = xy_m[np.arange(len(xy_m)), last]
    return np.asarray(np.linalg.norm(ends_m - xy_m[:, 0], axis=-1))
