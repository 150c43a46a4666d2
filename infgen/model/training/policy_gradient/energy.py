"""Gradients of energy scores: what one value costs among those of all rollouts.

The score (Gneiting and Raftery 2007) is best where rollouts and logs have the same
distribution, and there no value costs more than another.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from infgen.model.training_settings import LEAST_ROLLOUTS


def energy_by_agent(
    values: Float32[Tensor, "rollout token agent *value"],
    logged: Float32[Tensor, "rollout token agent *value"],
    counts: Bool[Tensor, "rollout token agent"],
    group: int,
    distance: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """Compare each agent with itself in the log, and in the other rollouts of its scene.

    With n rollouts that have the agent, the distance of one to the others is summed up and
    divided by n - 2, not by their number n - 1: the mean cost of the others, which
    ``advantages`` subtracts, holds the same distances once more. With fewer than three
    rollouts that part is left out.

    Args:
        values: Of rollouts.
        logged: Of the log, in the same rows.
        counts: Where the log and the rollout have the agent.
        group: Rollouts of each scene; the first of each scene, then the second, ...
        distance: Of values [..., agent, *value], metric.

    Returns:
        Costs, and energy scores, whose mean they lower [rollout, token, agent].
    """
    to_log = distance(values, logged)
    each, there = (x.reshape(group, -1, *x.shape[1:]) for x in (values, counts))
    between = torch.zeros_like(to_log)
    for number in range(group):
        both = there & there[number]
        between += (distance(each, each[number]) * both).flatten(0, 1)
    count = there.sum(dim=0).expand_as(there).flatten(0, 1)
    spread = between / (count - (LEAST_ROLLOUTS - 1)).clamp(min=1)
    spread = torch.where(count >= LEAST_ROLLOUTS, spread, 0.0)
    score = to_log - between / (2 * (count - 1)).clamp(min=1)
    return torch.where(counts, to_log - spread, 0.0), torch.where(counts, score, 0.0)


def energy_gradient(
    values: Float32[np.ndarray, " value"], logged: Float32[np.ndarray, " logged"]
) -> Float32[np.ndarray, " value"]:
    """Mean distance of each value to the logged ones less that to the other values.

    Zero where there is nothing logged, or only one value.
    """
    others = len(values) - 1
    if others < 1 or not len(logged):
        return np.zeros(len(values), dtype=np.float32)
    to_log = _summed_distance(values, logged) / len(logged)
    return (to_log - _summed_distance(values, values) / others).astype(np.float32)


def _summed_distance(values: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Sum the distances of each value to all others, of which it may be one."""
    ordered = np.sort(others.astype(np.float64))
    sums = np.concatenate([[0], np.cumsum(ordered)])
    below = np.searchsorted(ordered, values)
    at_most = values * below - sums[below]
    above: np.ndarray = sums[-1] - sums[below] - values * (len(ordered) - below)
    return at_most + above
