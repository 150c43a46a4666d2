"""The distribution that motion tokens are sampled from, in the plainest way."""

import torch
from torch import Tensor


def nucleus_distribution(logits: Tensor, apart: Tensor, top_p: float) -> Tensor:
    """Probability of every choice [row, choice]: each group has a nucleus of its own.

    Args:
        logits: [row, choice].
        apart: Which choices are of the first group [row, choice].
        top_p: Share of the probability of its group that a nucleus has.
    """
    share, order = logits.double().softmax(dim=-1).sort(dim=-1, descending=True)
    found = torch.zeros_like(share)
    for group in (apart.gather(1, order), ~apart.gather(1, order)):
        own = share * group
        whole = own.sum(dim=-1, keepdim=True)
        kept = own * (own.cumsum(dim=-1) - own < top_p * whole)
        found += whole * kept / kept.sum(dim=-1, keepdim=True).clamp(min=1e-300)
    return torch.zeros_like(share).scatter(1, order, found)
