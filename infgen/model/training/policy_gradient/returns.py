"""From rewards to advantages: discounted returns less those of other rollouts.

Arrays are [group, scene, token, agent], a group being one rollout of every scene. What an
agent gets at a token step, and later, is owed to the choice that led it there: its motion
token, or the place where it was inserted.
"""

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

TOKEN, AGENT = 1, 2
"""Dimensions within one rollout of one scene, counted behind the group."""


def discounted_returns(
    reward: Float32[Tensor, "group scene token *agent"], discount: float
) -> Float32[Tensor, "group scene token *agent"]:
    """Sum the rewards from each token step on, each discounted by its distance."""
    found = reward.clone()
    for token in range(reward.shape[2] - 2, -1, -1):
        found[:, :, token] += discount * found[:, :, token + 1]
    return found


def advantages(
    returns: Float32[Tensor, "group scene token agent"],
    moved: Bool[Tensor, "group scene token agent"],
    inserted: Bool[Tensor, "group scene token agent"],
    known: Bool[Tensor, "group scene agent"],
) -> Float32[Tensor, "group scene token agent"]:
    """Subtract the mean return of other rollouts of the same scene (leave one out).

    Of an agent that all rollouts have: the mean return of the same agent at the same token
    step. Of the moves of inserted agents: that of the moves of inserted agents at the same
    token step. Of insertions: that of all insertions. The mean is independent of what the
    rollout itself chose, so it adds no bias. Where the others have none, the advantage is
    zero. No scale is divided by: advantages have the unit of the rewards, however a batch
    is cut up.

    Args:
        returns: Of every choice.
        moved: Agents whose motion token was sampled.
        inserted: Agents that were inserted.
        known: Rows that hold the same agent in all rollouts of a scene.
    """
    of_known = known[:, :, None]
    found = _leave_one_out(returns, moved & of_known, ())
    found += _leave_one_out(returns, moved & ~of_known, (AGENT,))
    return found + of_insertions(returns, inserted)


def of_insertions(
    values: Float32[Tensor, "group scene token agent"],
    inserted: Bool[Tensor, "group scene token agent"],
) -> Float32[Tensor, "group scene token agent"]:
    """Subtract from each insertion's value the mean of the other rollouts' insertions."""
    return _leave_one_out(values, inserted, (TOKEN, AGENT))


def of_rollouts(
    returns: Float32[Tensor, "group scene token"],
    goes_on: Bool[Tensor, "group scene token"],
) -> Float32[Tensor, "group scene token"]:
    """Subtract from each rollout's return the mean of the others at the same token step."""
    return _leave_one_out(returns, goes_on, ())


def _leave_one_out(returns: Tensor, mask: Tensor, within: tuple[int, ...]) -> Tensor:
    """Returns less the mean over other rollouts, and over dimensions within a rollout."""
    dims = tuple(each + 1 for each in within)
    count = mask.to(returns)
    total = returns * count
    if dims:
        count, total = (x.sum(dim=dims, keepdim=True) for x in (count, total))
    others, sums = count.sum(dim=0) - count, total.sum(dim=0) - total
    baseline = sums / others.clamp(min=1)
    return torch.where(mask & (others > 0), returns - baseline, 0.0)
