"""Random numbers that belong to a rollout, whatever runs beside it.

Every draw is keyed by (seed, scene, rollout, token, purpose) and made by a counter-based
generator, so a rollout does not change with the batch, the worker or the order of work.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64


class Purpose(IntEnum):
    """What a number decides."""

    MOTION_TOKEN = 0
    LEAVE = 1
    ADD = 2
    CELL = 3
    AGENT_TYPE = 4
    HEADING = 5
    PATTERN = 6


@dataclass(frozen=True, slots=True)
class Stream:
    """The random numbers of one rollout."""

    key: int

    @classmethod
    def of(cls, seed: int, scenario_id: str, index: int) -> "Stream":
        """Make the stream of one rollout of one scene."""
        text = f"{seed}/{scenario_id}/{index}"
        return cls(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))

    def uniform(
        self, token: int, purpose: Purpose, count: int, turn: int = 0
    ) -> Float64[np.ndarray, " count"]:
        """Draw numbers in [0, 1): the same for the same arguments, always.

        Args:
            token: Half second that the draw is made in.
            purpose: What it decides.
            count: How many; a longer draw starts with the shorter one.
            turn: Which draw of that purpose in this token step (the n-th inserted agent).
        """
        # The lowest word counts within a draw; the others name the draw.
        counter = [0, turn, token, int(purpose)]
        return np.random.Generator(np.random.Philox(key=self.key, counter=counter)).random(
            count
        )


def draw_uniforms(
    streams: Sequence[Stream], token: int, purpose: Purpose, count: int, turn: int = 0
) -> Float64[np.ndarray, "stream count"]:
    """Draw [stream, count] numbers, a row from each stream."""
    return np.stack([stream.uniform(token, purpose, count, turn) for stream in streams])
