"""Likelihood of logged insertions and removals under latent rates.

What a scene's latent rates were is not logged, so the likelihood is the mean over all they
may have been. On a grid of values that is exact, by the forward algorithm of hidden Markov
models (Rabiner 1989), one token step after the other.
"""

from dataclasses import dataclass

from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from infgen.model.latent_rates import Rate, RateProcess


@dataclass(frozen=True, slots=True)
class Decisions:
    """Decisions to insert, or to remove, of a batch.

    Attributes:
        logit: Log-odds, before the latent rate.
        happens: 1 where it happened, else 0.
        token_step: Number of the scene times tokens plus that of the token step.
        counted: 1 for decisions that count, else 0; None where all do.
    """

    logit: Float[Tensor, " decision"]
    happens: Float[Tensor, " decision"]
    token_step: Int64[Tensor, " decision"]
    counted: Float[Tensor, " decision"] | None = None


@dataclass(frozen=True, slots=True)
class RateLikelihood:
    """What decisions of one kind are worth under their latent rate.

    Attributes:
        loss: Negative log-likelihood of all decisions.
        predicted: How many were expected to happen, before any of them was known.
    """

    loss: Tensor
    predicted: Tensor


def rate_likelihood(
    decisions: Decisions, rate: Rate, process: RateProcess, scenes: int, tokens: int
) -> RateLikelihood:
    """Compute the likelihood of all decisions of one kind.

    Args:
        decisions: In any order.
        rate: Their kind.
        process: Latent rates.
        scenes: Scenes of the batch; their rates are independent ...
        tokens: ... and token steps of each.
    """
    prior = process.log_prior()
    added = process.mean[rate] + process.scale[rate] * process.nodes()
    log_odds = decisions.logit.float()[:, None] + added  # [decision, node]
    happens = decisions.happens.float()[:, None].expand_as(log_odds)
    each = -functional.binary_cross_entropy_with_logits(log_odds, happens, reduction="none")
    expected = log_odds.sigmoid() @ prior.exp()
    if decisions.counted is not None:
        counted = decisions.counted.float()
        each, expected = each * counted[:, None], expected * counted
    of_token = each.new_zeros((scenes * tokens, len(prior)))
    of_token = of_token.index_add(0, decisions.token_step, each)
    of_token = of_token.view(scenes, tokens, -1)
    transition = process.log_transition()[rate]
    forward = prior + of_token[:, 0]
    for token in range(1, tokens):
        came = (forward[:, :, None] + transition).logsumexp(dim=1)
        forward = came + of_token[:, token]
    return RateLikelihood(-forward.logsumexp(dim=1).sum(), expected.sum())
