"""Motion tokens as rollouts sample them: from the nucleus, with their log-probabilities.

As in ``rollout.sampling``: tokens that stand still and tokens that move have a nucleus each
and keep the probability that they have together. Here the log-probabilities of what was
sampled have a gradient; the nucleus itself has none.
"""

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor


def log_probabilities(
    logits: Float[Tensor, "row choice"],
    stationary: Bool[Tensor, "row choice"],
    top_p: float,
    chosen: Int64[Tensor, " row"] | None = None,
) -> Float[Tensor, "row choice"]:
    """Log-probability of every choice; minus infinity outside the nuclei.

    Args:
        logits: Of the choices.
        stationary: Which of them have a nucleus of their own.
        top_p: Share of the probability of its group that a nucleus has; 1 for all choices.
        chosen: Choices that belong to the nucleus whatever it is: rounding may put the
            last one of a nucleus outside in another pass.
    """
    whole = logits.log_softmax(dim=-1)
    if top_p >= 1:
        return whole
    kept = _nuclei(whole.detach(), stationary, top_p)
    if chosen is not None:
        kept = kept.scatter(1, chosen[:, None], value=True)
    found = torch.full_like(whole, -torch.inf)
    for group in (stationary, ~stationary):
        lost = _together(whole, group) - _together(whole, group & kept)
        found = torch.where(group & kept, whole + lost, found)
    return found


def sample(
    log_probability: Float[Tensor, "row choice"], uniform: Float64[Tensor, " row"]
) -> Int64[Tensor, " row"]:
    """Sample choices by uniform numbers in [0, 1)."""
    reached = log_probability.double().exp().cumsum(dim=-1)
    rank = (uniform[:, None] * reached[:, -1:] >= reached).sum(dim=-1)
    return rank.clamp(max=reached.shape[-1] - 1)


def _nuclei(whole: Tensor, stationary: Tensor, top_p: float) -> Tensor:
    """Mark the likeliest choices of each group that have a share of its probability."""
    share, order = whole.exp().sort(dim=-1, descending=True, stable=True)
    apart = stationary.gather(1, order)
    kept = torch.zeros_like(stationary)
    for group in (apart, ~apart):
        own = share * group
        reached = own.cumsum(dim=-1)
        kept |= group & (reached - own < top_p * reached[:, -1:])
    return torch.zeros_like(kept).scatter(1, order, kept)


def _together(whole: Tensor, group: Tensor) -> Tensor:
    """Logarithm of the probability of a group [row, 1]; 0 of an empty one."""
    some = group.any(dim=-1, keepdim=True)
    # An empty group keeps all: its value is not used, and its gradient is a number.
    masked = whole.masked_fill(~group & some, -torch.inf)
    return masked.logsumexp(dim=-1, keepdim=True)
