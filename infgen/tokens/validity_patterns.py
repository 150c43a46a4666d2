"""When within each half second the log shows an agent: five times yes or no as one number.

Detectors lose agents for a step or two and find them again. Poses and moves are of tracks
with such gaps filled; a pattern tells of the gaps: bit ``i`` of a token's pattern (0 to 31)
says whether the log shows the agent at step ``i + 1`` of the token.
"""

import numpy as np
from jaxtyping import Bool, UInt8

from infgen.clock import CLOCK, Clock


def encode_patterns(
    valid: Bool[np.ndarray, "agent step"], clock: Clock = CLOCK
) -> UInt8[np.ndarray, "agent token"]:
    """Write what the log shows of each agent, token by token; step 0 is in none of them."""
    length = clock.steps_per_token
    tokens = clock.num_tokens(valid.shape[1])
    steps = valid[:, 1 : 1 + length * tokens].reshape(len(valid), tokens, length)
    return np.packbits(steps, axis=-1, bitorder="little")[..., 0]


def decode_patterns(
    pattern: UInt8[np.ndarray, "agent token"], clock: Clock = CLOCK
) -> Bool[np.ndarray, "agent step"]:
    """Tell the steps at which the log shows each agent; False at step 0, in no token.

    Inverse of ``encode_patterns`` at all other steps.
    """
    agents, tokens = pattern.shape
    length = clock.steps_per_token
    steps = np.unpackbits(pattern[..., None], axis=-1, count=length, bitorder="little")
    return np.pad(steps.astype(bool).reshape(agents, tokens * length), ((0, 0), (1, 0)))
