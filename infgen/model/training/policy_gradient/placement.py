"""Where vehicles are inserted, beside where the log inserts them: on the road or off it.

A vehicle that is inserted off the road (into a parking lot) hits no agent and cannot leave
the road any more, so that the other costs alone teach to insert there. The placement cost
is the gradient of an energy score of the signed distance off the road: of the vehicles that
the rollouts of a scene insert, against those that its log inserts.
"""

import numpy as np
from jaxtyping import Bool, Float32

from infgen.model.batching.batch import Agents
from infgen.model.training.policy_gradient.energy import energy_gradient
from infgen.model.training.policy_gradient.road import Road
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType

LIMIT_M = 1.0
"""Distances off the road, and on it from the edge, are cut off here: what counts is the
side of the edge, and by less than this how near."""


def placement_costs(
    rollouts: SimulatedRollouts, roads: list[Road]
) -> Float32[np.ndarray, "rollout token agent"]:
    """Compute the placement cost of every inserted vehicle, in metres.

    Zero for other agents, and in scenes where the log inserts no vehicle or the rollouts
    fewer than two.

    Args:
        rollouts: Simulated agents.
        roads: Of every scene.
    """
    scenes, logged = len(roads), rollouts.logged
    log_inserts = (logged.presence == INSERTED) & logged.visible
    log_inserts[:, :HISTORY_TOKENS] = False
    inserted = rollouts.inserted.numpy(force=True)
    cost = np.zeros(inserted.shape, dtype=np.float32)
    for scene, road in enumerate(roads):
        each, one = slice(scene, None, scenes), slice(scene, scene + 1)
        is_logged = log_inserts[one].numpy(force=True)
        _, logged_off_m = _vehicles_off_m(logged, one, is_logged, road)
        at, off_m = _vehicles_off_m(rollouts.batch.agents, each, inserted[each], road)
        cost[each][at] = energy_gradient(off_m, logged_off_m)
    return cost


def _vehicles_off_m(
    agents: Agents, rows: slice, inserted: Bool[np.ndarray, "row token agent"], road: Road
) -> tuple[tuple[np.ndarray, ...], Float32[np.ndarray, " vehicle"]]:
    """Find inserted vehicles: where [row, token, agent], and how far off the road."""
    pose, size_lwh_m, agent_type = (
        each[rows].numpy(force=True)
        for each in (agents.pose, agents.size_lwh_m, agents.agent_type)
    )
    at = np.nonzero(inserted & (agent_type == AgentType.VEHICLE)[:, None])
    off_m = road.off_m(pose[at], size_lwh_m[at[0], at[2], :2])
    return at, off_m.clip(-LIMIT_M, LIMIT_M)
