"""Latent rates of batches that the network simulates itself (``model.latent_rates``).

``infgen.rollout.rate_states`` does the same for rollouts, from random streams of their own.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from infgen.model.latent_rates import Rate, RateProcess
from infgen.model.training.own_choices import UniformNumbers

LEAST_UNIFORM = 2.0**-53
"""In place of a uniform number of zero, whose normal one would be infinite."""


class RateSamples:
    """The latent rates of a batch in simulation, token step by token step.

    Attributes:
        log_odds: What is added to log-odds; zeros up to the token step that is simulated,
            and where the network has no latent rates.
    """

    log_odds: Float64[Tensor, "rollout token 2"]

    def __init__(
        self, process: RateProcess | None, like: Tensor, uniforms: UniformNumbers
    ) -> None:
        """Begin before the first token step.

        Args:
            process: Latent rates; None for none.
            like: Any values of the batch [rollout, token, ...].
            uniforms: Random numbers.
        """
        shape, device = (*like.shape[:2], len(Rate)), like.device
        self.log_odds = torch.zeros(shape, dtype=torch.float64, device=device)
        self._process, self._uniforms = None, uniforms
        if process is not None:
            numbers = process.mean, process.scale, process.persistence
            self._process = [each.detach().double() for each in numbers]
        self._value: Tensor | None = None

    def advance(self, token: int) -> None:
        """Go on to the next token step."""
        if self._process is None:
            return
        mean, scale, kept = self._process
        uniform = self._uniforms.draw(len(self.log_odds), len(Rate))
        value = torch.special.ndtri(uniform.clamp(min=LEAST_UNIFORM))
        if self._value is not None:
            value = kept * self._value + (1 - kept.square()).sqrt() * value
        self._value = value
        self.log_odds[:, token] = mean + scale * value

    def of(self, rate: Rate, token: int) -> Float64[Tensor, " rollout"]:
        """Return what is added to the log-odds of one kind of decision."""
        return self.log_odds[:, token, rate]
