"""Latent rates of rollouts: what they add to the log-odds of insertions and removals.

Where the network has learned latent rates (``infgen.model.latent_rates``) each rollout
samples its own, one value of each per token step.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.model.latent_rates import Rate
from infgen.rollout.random_streams import Purpose, Streams


class RateStates:
    """The latent rates of a batch of rollouts, at one token step."""

    def __init__(self, process: Float64[np.ndarray, "3 2"], rollouts: int) -> None:
        """Begin before the first token step.

        Args:
            process: Mean, scale and persistence, by ``Rate``.
            rollouts: How many.
        """
        self._mean, self._scale, self._persistence = process
        self._token = -1
        self._value: Float64[np.ndarray, "rollout 2"] = np.zeros((rollouts, len(Rate)))
        self._begun: Bool[np.ndarray, " rollout"] = np.zeros(rollouts, dtype=bool)

    def advance(self, streams: Streams, token: int) -> None:
        """Go on to a token step of the batch; nothing happens if it is at that already.

        Args:
            streams: Random numbers of the rollouts.
            token: The next token step, or the same one.
        """
        if token == self._token:
            return
        kept = np.where(self._begun[:, None], self._persistence, 0.0)
        normal = _normal(streams, token)
        self._value = kept * self._value + np.sqrt(1 - kept**2) * normal
        self._begun[:], self._token = True, token

    def log_odds(self, rate: Rate) -> Float64[np.ndarray, " rollout"]:
        """Return what is added to log-odds in this token step."""
        added: np.ndarray = self._mean[rate] + self._scale[rate] * self._value[:, rate]
        return added

    def put(self, rollouts: Int64[np.ndarray, " replaced"], others: "RateStates") -> None:
        """Replace those of some rollouts by those of others."""
        self._value[rollouts] = others._value
        self._begun[rollouts] = others._begun


def _normal(streams: Streams, token: int) -> Float64[np.ndarray, "rollout 2"]:
    """Draw a normal number for each rate (Box and Muller 1958)."""
    first, second = streams.uniform_block(token, (Purpose.RATE,), 0)[0, :, :2].T
    length, angle_rad = np.sqrt(-2 * np.log1p(-first)), 2 * np.pi * second
    return np.stack([length * np.cos(angle_rad), length * np.sin(angle_rad)], axis=1)
