"""Which types inserted agents have, beside those that the log inserts.

A type is no risk, so that the other costs are not those of its choice: it has a cost of its
own, the gradient of an energy score whose distance is one between two types: the share of
an agent's type among the other agents that the rollouts of a scene insert, less that among
the agents that its log inserts.
"""

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn.functional import one_hot

from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType


def type_costs(rollouts: SimulatedRollouts) -> Float32[Tensor, "rollout token agent"]:
    """Compute the cost of the type of every inserted agent, a difference of two shares.

    Zero for other agents, and in scenes where the log inserts no agent or the rollouts
    fewer than two.
    """
    agents, logged, scenes = rollouts.batch.agents, rollouts.logged, rollouts.scenes
    inserted = rollouts.inserted
    log_inserts = (logged.presence == INSERTED) & logged.visible
    log_inserts[:, :HISTORY_TOKENS] = False
    ours = _by_type(inserted, agents.agent_type).view(rollouts.count, scenes, -1).sum(dim=0)
    logs = _by_type(log_inserts, logged.agent_type)[:scenes]
    others, count = ours.sum(dim=1, keepdim=True) - 1, logs.sum(dim=1, keepdim=True)
    cost = (ours - 1) / others.clamp(min=1) - logs / count.clamp(min=1)
    cost = torch.where((others > 0) & (count > 0), cost, 0.0).repeat(rollouts.count, 1)
    of_row = cost.gather(1, agents.agent_type)[:, None]
    return torch.where(inserted, of_row, 0.0)


def _by_type(inserted: Tensor, agent_type: Tensor) -> Float32[Tensor, "rollout type"]:
    """Count inserted agents by their type."""
    each = one_hot(agent_type, len(AgentType)) * inserted.sum(dim=1)[..., None]
    return each.sum(dim=1).float()
