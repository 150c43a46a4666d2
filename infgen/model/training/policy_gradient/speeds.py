"""How fast vehicles drive, beside how fast the log's do.

Slow vehicles collide less, so that the other costs alone teach low speeds. The speed cost
is the gradient of an energy score:

- of a vehicle of the history, of its speed at one token step;
- of vehicles inserted since, of all speeds in their first token step, and of all those
  later on: a scene inserts too few vehicles to compare them token step by token step.
"""

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.batching.batch import Agents
from infgen.model.batching.supervision import preceding
from infgen.model.training.policy_gradient.energy import energy_by_agent, energy_gradient
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType


def speed_costs(rollouts: SimulatedRollouts) -> Float32[Tensor, "rollout token agent"]:
    """Compute the speed cost of every vehicle that moved, in m/s.

    Zero for other agents, and where there is nothing to compare with.
    """
    agents, logged = rollouts.batch.agents, rollouts.logged
    log_inserts = (logged.presence == INSERTED) & logged.visible
    own_mps, logged_mps = _speed_mps(agents), _speed_mps(logged)
    own = rollouts.moved & _vehicles(agents)
    log = logged.observed & preceding(logged.visible) & _vehicles(logged)
    log[:, :HISTORY_TOKENS] = False
    log &= ~log_inserts
    known = rollouts.known[:, None]
    cost, _ = energy_by_agent(
        own_mps, logged_mps, own & log & known, rollouts.count, _difference
    )
    firsts = preceding(rollouts.inserted), preceding(log_inserts)
    for first in (True, False):
        of_own, of_log = (
            each & ~known & (begins == first)
            for each, begins in zip((own, log), firsts, strict=True)
        )
        cost += _by_scene(own_mps, of_own, logged_mps, of_log, rollouts.scenes)
    return cost


def _by_scene(
    own_mps: Tensor, own: Tensor, logged_mps: Tensor, log: Tensor, scenes: int
) -> Tensor:
    """Compare all speeds of a scene's rollouts with all of its log."""
    cost = np.zeros(own_mps.shape, dtype=np.float32)
    values_mps, counts, logs_mps, log_counts = (
        each.numpy(force=True) for each in (own_mps, own, logged_mps, log)
    )
    for scene in range(scenes):
        rows = slice(scene, None, scenes)
        at = np.nonzero(counts[rows])
        logs = logs_mps[scene][log_counts[scene]]
        cost[rows][at] = energy_gradient(values_mps[rows][at], logs)
    return torch.from_numpy(cost).to(own_mps.device)


def _speed_mps(agents: Agents) -> Float32[Tensor, "rollout token agent"]:
    """Mean speeds over token steps; zero in the first."""
    xy_m = agents.pose[..., :2]
    return xy_m.diff(dim=1, prepend=xy_m[:, :1]).norm(dim=-1) / CLOCK.token_s


def _vehicles(agents: Agents) -> Tensor:
    return (agents.agent_type == int(AgentType.VEHICLE))[:, None]


def _difference(speed_mps: Tensor, other_mps: Tensor) -> Tensor:
    return (speed_mps - other_mps).abs()
