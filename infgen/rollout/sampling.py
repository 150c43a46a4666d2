"""From logits and given uniform numbers to choices."""

import torch
from torch import Tensor


def choose(logits: Tensor, uniform: Tensor, top: int = 0) -> Tensor:
    """Sample the last dimension by inverting its cumulative distribution.

    Args:
        logits: [..., choice].
        uniform: [...] numbers in [0, 1), one per sample.
        top: Sample from so many most likely choices only; 0 for all of them.

    Returns:
        Indices [...], int64.
    """
    count = logits.shape[-1]
    keep = min(top, count) if top else count
    best, index = logits.double().topk(keep, dim=-1)
    reached = best.softmax(dim=-1).cumsum(dim=-1)
    rank = (uniform[..., None] >= reached).sum(dim=-1).clamp(max=keep - 1)
    return index.gather(-1, rank[..., None])[..., 0]


def happens(logit: Tensor, uniform: Tensor) -> Tensor:
    """Decide events [...] of given log-odds: True with their probability."""
    return uniform < torch.sigmoid(logit.double())
