"""From logits and given uniform numbers to choices."""

import torch
from torch import Tensor


def choose(
    logits: Tensor,
    uniform: Tensor,
    top: int = 0,
    *,
    nucleus: float = 1.0,
    temperature: float = 1.0,
) -> Tensor:
    """Sample the last dimension by inverting its cumulative distribution.

    Args:
        logits: [..., choice]; what cannot be is minus infinity.
        uniform: [...] numbers in [0, 1), one per sample.
        top: Sample from so many most likely choices only; 0 for all of them.
        nucleus: Of these, only from the fewest likeliest that have this share of their
            probability together.
        temperature: Logits are divided by it first.

    Returns:
        Indices [...], int64.
    """
    count = logits.shape[-1]
    keep = min(top, count) if top else count
    best, index = logits.topk(keep, dim=-1)
    share = (best.double() / temperature).softmax(dim=-1)
    reached = share.cumsum(dim=-1)
    likely = share > 0
    if nucleus < 1:
        likely &= reached - share < nucleus
    last = likely.sum(dim=-1).clamp(min=1) - 1
    sought = uniform
    if nucleus < 1:
        sought = uniform * reached.gather(-1, last[..., None])[..., 0]
    rank = (sought[..., None] >= reached).sum(dim=-1).minimum(last)
    return index.gather(-1, rank[..., None])[..., 0]


def happens(logit: Tensor, uniform: Tensor, bias: float = 0.0) -> Tensor:
    """Decide events [...] of given log-odds plus a bias: True with their probability."""
    return uniform < torch.sigmoid(logit.double() + bias)
