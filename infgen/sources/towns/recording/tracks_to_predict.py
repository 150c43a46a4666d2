"""Roles of agents: who is to be predicted, and who is of interest."""

import numpy as np
from jaxtyping import Int8, Int32

from infgen.scene import AgentType, Tracks

MAX_PREDICT = 8


def to_predict(
    tracks: Tracks, now: int
) -> tuple[Int32[np.ndarray, " predict"], Int8[np.ndarray, " predict"]]:
    """Choose tracks seen now and long after: first all kinds, then whoever moves most.

    The last track is the recording car's and not chosen.
    """
    others = np.arange(tracks.num_agents) < tracks.num_agents - 1
    long_seen = tracks.valid[:, now] & (tracks.valid[:, now:].mean(axis=1) > 0.6)
    able = np.flatnonzero(others & long_seen)
    speed_mps = np.linalg.norm(tracks.velocity_mps[able], axis=-1).mean(axis=1)
    _, first = np.unique(tracks.agent_type[able], return_index=True)
    foremost = np.isin(np.arange(len(able)), first)
    order = np.lexsort((able, -speed_mps, ~foremost))
    chosen = np.sort(able[order][:MAX_PREDICT])
    turned_rad = np.ptp(np.where(tracks.valid, np.unwrap(tracks.heading_rad), 0.0), axis=1)
    hard = (tracks.agent_type != AgentType.VEHICLE) | (turned_rad > 0.5)
    return chosen.astype(np.int32), np.where(hard[chosen], 2, 1).astype(np.int8)


def of_interest(
    tracks: Tracks, predict: Int32[np.ndarray, " predict"]
) -> Int32[np.ndarray, " interest"]:
    """Name the two tracks to predict that come nearest to each other."""
    if len(predict) < 2:
        return np.zeros(0, np.int32)
    xy_m = tracks.xyz_m[predict, :, :2]
    both = tracks.valid[predict][:, None] & tracks.valid[predict][None]
    apart_m = np.linalg.norm(xy_m[:, None] - xy_m[None], axis=-1)
    nearest_m = np.where(both, apart_m, np.inf).min(axis=-1)
    nearest_m[np.diag_indices(len(predict))] = np.inf
    one, other = np.unravel_index(nearest_m.argmin(), nearest_m.shape)
    return tracks.id[predict[[one, other]]]
