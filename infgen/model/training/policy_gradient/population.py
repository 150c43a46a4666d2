"""How many agents a rollout has and how many came, beside the log's numbers.

Whether to insert an agent or to remove one is no choice of that agent, so what it brings is
a cost of the whole rollout: at each token step the gradient of an energy score of two
numbers, of the agents that are there and of those that were inserted so far. Agents that
left are then the logged number too.
"""

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
)
from infgen.model.training.simulation import INSERTED
from infgen.model.training_settings import LEAST_ROLLOUTS


def count_costs(rollouts: SimulatedRollouts) -> Float32[Tensor, "rollout token"]:
    """Compute the count cost of every rollout at every token step, in agents.

    The distance to the other rollouts is divided by their number less one, as in the log
    distance: the advantage holds it once more.
    """
    logged, scenes = rollouts.logged, rollouts.scenes
    there = rollouts.moved | rollouts.inserted
    goes_on = there.any(dim=2)
    log_inserts = (logged.presence == INSERTED) & logged.visible
    ours = _numbers(there, rollouts.inserted)
    logs = _numbers(logged.visible, log_inserts)
    each = ours.view(rollouts.count, scenes, *ours.shape[1:])
    between = (each[:, None] - each).abs().sum(dim=(1, -1)).flatten(0, 1)
    to_log = (ours - logs).abs().sum(dim=-1)
    cost = to_log - between / (rollouts.count - (LEAST_ROLLOUTS - 1))
    return torch.where(goes_on, cost, 0.0)


def _numbers(
    there: Bool[Tensor, "rollout token agent"],
    inserted: Bool[Tensor, "rollout token agent"],
) -> Float32[Tensor, "rollout token 2"]:
    """Count agents that are there, and those that were inserted since the history."""
    came = inserted.sum(dim=2)
    came[:, :HISTORY_TOKENS] = 0
    return torch.stack([there.sum(dim=2), came.cumsum(dim=1)], dim=-1).float()
