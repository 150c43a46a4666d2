"""Log-probabilities of motion tokens that were sampled from a nucleus.

As in ``sampling.choose``: tokens that stand still and tokens that move have a nucleus each
and keep the probability that they have together. Log-probabilities have a gradient; the
nucleus itself has none.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from infgen.model.sampling import sort_likely


def log_probability(
    logits: Float[Tensor, "row choice"],
    stationary: Bool[Tensor, "row choice"],
    top_p: float,
    chosen: Int64[Tensor, " row"],
) -> Float[Tensor, " row"]:
    """Log-probability of the choice that was made.

    Args:
        logits: Of the choices.
        stationary: Which of them have a nucleus of their own.
        top_p: Share of the probability of its group that a nucleus has; 1 for all choices.
        chosen: Belongs to the nucleus whatever it is: rounding may put the last one of a
            nucleus outside in another pass.
    """
    at = chosen[:, None]
    likely = logits.gather(1, at)[:, 0] - logits.logsumexp(dim=-1)
    if top_p >= 1:
        return likely
    group = stationary == stationary.gather(1, at)
    own = logits.masked_fill(~group, -torch.inf)
    kept = _nucleus(own.detach(), top_p).scatter(1, at, value=True)
    nucleus = logits.masked_fill(~kept, -torch.inf)
    return likely + own.logsumexp(dim=-1) - nucleus.logsumexp(dim=-1)


def _nucleus(logits: Tensor, top_p: float) -> Tensor:
    """Mark the fewest likeliest choices [row, choice] that have a share of all."""
    share = logits.softmax(dim=-1)
    # All that are less likely than this have less than ``1 - top_p`` together.
    likely = share > (1 - top_p) / logits.shape[-1]
    kept = torch.zeros_like(likely)
    for rows, index in sort_likely(logits, likely):
        own, some = (x[rows].gather(1, index) for x in (share, likely))
        before = own.cumsum(dim=-1) - own
        kept[rows] = kept[rows].scatter(1, index, some & (before < top_p))
    return kept
