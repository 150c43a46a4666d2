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
    apart: Tensor | None = None,
) -> Tensor:
    """Sample the last dimension by inverting its cumulative distribution.

    Args:
        logits: [..., choice]; what cannot be is minus infinity.
        uniform: [...] numbers in [0, 1), one per sample.
        top: Sample from so many most likely choices only; 0 for all of them.
        nucleus: Of these, only from the fewest likeliest that have this share of their
            probability together.
        temperature: Logits are divided by it first.
        apart: Which choices have a nucleus of their own [..., choice]: they and the others
            each keep the probability that they have together.

    Returns:
        Indices [...], int64.
    """
    count = logits.shape[-1]
    keep = min(top, count) if top else count
    best, index = logits.topk(keep, dim=-1)
    share = (best.double() / temperature).softmax(dim=-1)
    if nucleus < 1:
        share = _within(share, nucleus, None if apart is None else apart.gather(-1, index))
    reached = share.cumsum(dim=-1)
    # Beyond the last likely one nothing is reached any more, whatever rounding does.
    last = _last(share > 0)
    sought = uniform * reached[..., -1] if nucleus < 1 else uniform
    rank = (sought[..., None] >= reached).sum(dim=-1).minimum(last)
    return index.gather(-1, rank[..., None])[..., 0]


def _within(share: Tensor, nucleus: float, apart: Tensor | None) -> Tensor:
    """Keep the nucleus of descending shares, or those of two groups of them."""
    if apart is None:
        return share * (share.cumsum(dim=-1) - share < nucleus)
    kept = torch.zeros_like(share)
    for group in (apart, ~apart):
        own = share * group
        reached = own.cumsum(dim=-1)
        whole = reached[..., -1:]
        some = own * (reached - own < nucleus * whole)
        kept += some * (whole / some.sum(dim=-1, keepdim=True).clamp(min=1e-300))
    return kept


def _last(likely: Tensor) -> Tensor:
    """Place of the last true value of the last dimension; 0 if there is none."""
    places = torch.arange(likely.shape[-1], device=likely.device)
    return (likely * places).amax(dim=-1)


def sample_event(logit: Tensor, uniform: Tensor, bias: float | Tensor = 0.0) -> Tensor:
    """Decide events [...] of given log-odds plus a bias: True with their probability."""
    return uniform < torch.sigmoid(logit.double() + bias)
