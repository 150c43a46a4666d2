"""How many agents enter and leave, beyond what is seen: latent rates of a scene.

Decisions that are independent given what the network sees make numbers of entries and exits
that vary by little more than Poisson's. Those of logs vary several times as much: vehicles
come in platoons, and what makes a street busy is often out of sight. So both are
log-Gaussian Cox processes (Moller et al. 1998, "Log Gaussian Cox Processes"): to the
log-odds of every insertion, and of every removal, of a token step is added

    mean + scale * z,

where z is the same for all agents of a scene and follows a stationary autoregressive
process of variance one,

    z' = persistence * z + sqrt(1 - persistence**2) * normal,

one for insertions and one for removals. The three numbers of each are learned by the
likelihood of logs (``infgen.model.training.rate_likelihood``); rollouts sample z
(``infgen.rollout.rate_states``), those to learn from too
(``infgen.model.training.rate_samples``). Elsewhere logits are those at z = 0 and without
the mean.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Float32, Float64
from torch import Tensor, nn

MOST_PERSISTENT = 0.98
"""Values of z are told apart on a grid of ``NUM_NODES``, which takes slower changes for
none."""
NUM_NODES = 33
NODE_RANGE = 3.2
"""Where the grid ends, in standard deviations of z."""
FIRST_SCALE = 0.1
"""Before training. Zero would stay zero: the likelihood is even in the scale."""
FIRST_PERSISTENCE = 0.9


class Rate(IntEnum):
    """What a latent rate is of."""

    INSERTION = 0
    REMOVAL = 1


@dataclass(frozen=True, slots=True)
class RateProcess:
    """The latent rates' numbers, by ``Rate``.

    Attributes:
        mean: Added to log-odds.
        scale: Standard deviation of what is added to log-odds.
        persistence: Correlation of two token steps, one after the other.
    """

    mean: Float32[Tensor, "2"]
    scale: Float32[Tensor, "2"]
    persistence: Float32[Tensor, "2"]

    def scaled(self, share: float) -> "RateProcess":
        """Return latent rates that vary less: ``share`` times as much.

        Means go with the square, as odds are multiplied by ``exp(scale**2 / 2)`` in the
        mean of all z.
        """
        return RateProcess(share**2 * self.mean, share * self.scale, self.persistence)

    def detached(self) -> "RateProcess":
        """Return the same numbers, which no gradient reaches."""
        return RateProcess(
            self.mean.detach(), self.scale.detach(), self.persistence.detach()
        )

    def nodes(self) -> Float32[Tensor, " node"]:
        """Return the grid of values of z."""
        return torch.linspace(-NODE_RANGE, NODE_RANGE, NUM_NODES, device=self.mean.device)

    def log_prior(self) -> Float32[Tensor, " node"]:
        """Return log-probabilities of z at any one token step."""
        return (-self.nodes().square() / 2).log_softmax(dim=0)

    def log_transition(self) -> Float32[Tensor, "2 node next"]:
        """Return log-probabilities of z a token step later."""
        nodes, kept = self.nodes(), self.persistence[:, None, None]
        gap = nodes - kept * nodes[:, None]
        return (-gap.square() / (2 * (1 - kept.square()))).log_softmax(dim=2)

    def on_host(self) -> Float64[Tensor, "3 2"]:
        """Return mean, scale and persistence, for rollouts."""
        each = torch.stack([self.mean, self.scale, self.persistence])
        return each.detach().double().cpu()


class LatentRates(nn.Module):
    """The parameters of the latent rates, by ``Rate``."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.empty(2))
        self.log_scale = nn.Parameter(torch.empty(2))
        self.persistence_logit = nn.Parameter(torch.empty(2))
        self.begin_at_zero()

    def begin_at_zero(self) -> None:
        """Let rates vary by little at first."""
        first = FIRST_PERSISTENCE / MOST_PERSISTENT
        with torch.no_grad():
            self.mean.zero_()
            self.log_scale.fill_(math.log(FIRST_SCALE))
            self.persistence_logit.fill_(math.log(first / (1 - first)))

    def forward(self) -> RateProcess:
        """Return the numbers."""
        persistence = MOST_PERSISTENT * self.persistence_logit.sigmoid()
        return RateProcess(self.mean, self.log_scale.exp(), persistence)
