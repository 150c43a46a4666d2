"""From logits and given uniform numbers to choices."""

from collections.abc import Iterator

import torch
from torch import Tensor

LIKELY = (64, 256)
"""Rows are sorted together by how many choices may be in their nuclei, up to so many."""


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
    if nucleus < 1 and not top and apart is not None and logits.device.type == "cpu":
        return _choose_likely(logits, uniform, nucleus, temperature, apart)
    count = logits.shape[-1]
    keep = min(top, count) if top else count
    best, index = logits.topk(keep, dim=-1)
    share = (best.double() / temperature).softmax(dim=-1)
    if nucleus < 1 and apart is None:
        share = share * (share.cumsum(dim=-1) - share < nucleus)
    elif nucleus < 1 and apart is not None:
        share = _within(share, nucleus, apart.gather(-1, index))
    rank = _rank(share, uniform, of_all=nucleus == 1)
    return index.gather(-1, rank[..., None])[..., 0]


def _choose_likely(
    logits: Tensor, uniform: Tensor, nucleus: float, temperature: float, apart: Tensor
) -> Tensor:
    """Sample from two nuclei as ``choose`` does, and sort only what may be in one.

    Of n choices those that have less than ``(1 - nucleus) / n`` of the probability of their
    group each have less than ``1 - nucleus`` of it together: none is in its nucleus.

    Args:
        logits: [row, choice].
        uniform: [row].
        nucleus: As for ``choose`` ...
        temperature: ... this too ...
        apart: ... and this [row, choice].
    """
    share = (logits.double() / temperature).softmax(dim=-1)
    one = torch.where(apart, share, 0.0).sum(dim=-1, keepdim=True)
    other = torch.where(apart, 0.0, share).sum(dim=-1, keepdim=True)
    outside = (1 - nucleus) / logits.shape[-1]
    likely = share > torch.where(apart, outside * one, outside * other)
    found = torch.zeros_like(likely[:, 0], dtype=torch.int64)
    for rows, index in sort_likely(logits, likely):
        own, group, some = (x[rows].gather(1, index) for x in (share, apart, likely))
        own = _within(own * some, nucleus, group, (one[rows], other[rows]))
        rank = _rank(own, uniform[rows], of_all=False)
        found[rows] = index.gather(1, rank[:, None])[:, 0]
    return found


def sort_likely(logits: Tensor, likely: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Sort what is likely of every row, the likeliest first.

    Args:
        logits: [row, choice].
        likely: What has to be sorted [row, choice]: at least one choice of a row.

    Yields:
        Some of the rows [n], and their choices [n, rank]: as many as are likely in one of
        these rows; ranks that others have besides are choices that are not likely.
    """
    logits = torch.where(likely, logits, -torch.inf)
    number = likely.sum(dim=-1)
    for least, most in zip((-1, *LIKELY), (*LIKELY, logits.shape[-1]), strict=True):
        rows = ((number > least) & (number <= most)).nonzero()[:, 0]
        if len(rows):
            index = logits[rows].topk(int(number[rows].max()), dim=-1).indices
            yield rows, index


def _within(
    share: Tensor,
    nucleus: float,
    apart: Tensor,
    wholes: tuple[Tensor | None, Tensor | None] = (None, None),
) -> Tensor:
    """Keep the nuclei of descending shares of two groups, each as likely as its whole.

    Args:
        share: [..., choice].
        nucleus: Share of the probability of each group.
        apart: Which choices are of the first one [..., choice].
        wholes: Their probabilities [..., 1]; None if all of them are among the shares.
    """
    kept = torch.zeros_like(share)
    for group, whole in zip((apart, ~apart), wholes, strict=True):
        own = share * group
        reached = own.cumsum(dim=-1)
        whole = reached[..., -1:] if whole is None else whole
        some = own * (reached - own < nucleus * whole)
        kept += some * (whole / some.sum(dim=-1, keepdim=True).clamp(min=1e-300))
    return kept


def _rank(share: Tensor, uniform: Tensor, *, of_all: bool) -> Tensor:
    """Find by which of shares [..., choice] a number [...] is reached, of them or of 1."""
    reached = share.cumsum(dim=-1)
    sought = uniform if of_all else uniform * reached[..., -1]
    rank = (sought[..., None] >= reached).sum(dim=-1)
    # Beyond the last likely one nothing is reached any more, whatever rounding does.
    return rank.minimum(_last(share > 0))


def _last(likely: Tensor) -> Tensor:
    """Place of the last true value of the last dimension; 0 if there is none."""
    places = torch.arange(likely.shape[-1], device=likely.device)
    return (likely * places).amax(dim=-1)


def sample_event(logit: Tensor, uniform: Tensor, bias: float | Tensor = 0.0) -> Tensor:
    """Decide events [...] of given log-odds plus a bias: True with their probability."""
    return uniform < torch.sigmoid(logit.double() + bias)
