"""Validity patterns: the steps of a token at which the log shows an agent, as a number.

Detectors lose agents for a step or two. Poses and motion tokens come from tracks with such
gaps filled; the pattern (0 to 31) records the gaps: bit ``i`` is set if the log shows the
agent at step ``i + 1`` of the token.
"""

import numpy as np
from jaxtyping import Bool, UInt8

from infgen.clock import CLOCK, Clock


def encode_patterns(
    valid: Bool[np.ndarray, "agent step"], clock: Clock = CLOCK
) -> UInt8[np.ndarray, "agent token"]:
    """Encode the logged validity of each token step; step 0 belongs to none."""
    length = clock.steps_per_token
    tokens = clock.num_tokens(valid.shape[1])
    steps = valid[:, 1 : 1 + length * tokens].reshape(len(valid), tokens, length)
    return np.packbits(steps, axis=-1, bitorder="little")[..., 0]


def decode_patterns(
    pattern: UInt8[np.ndarray, "agent token"], clock: Clock = CLOCK
) -> Bool[np.ndarray, "agent step"]:
    """Return the logged validity at every step; False at step 0, which no token holds.

    Inverse of ``encode_patterns`` at all other steps.
    """
    agents, tokens = pattern.shape
    length = clock.steps_per_token
    steps = np.unpackbits(pattern[..., None], axis=-1, count=length, bitorder="little")
    return np.pad(steps.astype(bool).reshape(agents, tokens * length), ((0, 0), (1, 0)))
