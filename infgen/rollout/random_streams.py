"""Random numbers that belong to a rollout, whatever runs beside it.

Every draw is keyed by (seed, scene, rollout, token, purpose) and made by a counter-based
generator, so a rollout does not change with the batch, the worker or the order of work.
The generator is Philox4x64-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1,
2, 3"), evaluated for all rollouts at once; its numbers are those of numpy's ``Philox``.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int64, UInt64

ROUNDS = 10
WORDS = 4
"""Numbers that one evaluation makes."""
_MULTIPLIERS = (np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157))
_KEY_STEPS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B))
_LOW, _HALF, _UNUSED_BITS = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(11)


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
class Streams:
    """The random numbers of some rollouts.

    Attributes:
        key: Key of each stream, its low word first.
        begun: Token step of the batch that is the first of each rollout's own: 0, but for
            rollouts that took the place of others.
    """

    key: UInt64[np.ndarray, "stream 2"]
    begun: Int64[np.ndarray, " stream"]

    @classmethod
    def of(cls, names: Iterable[tuple[int, str, int]]) -> "Streams":
        """Make streams, each from a seed, the id of a scene, and the index of a rollout."""
        digests = b"".join(
            hashlib.sha256(f"{seed}/{scenario_id}/{index}".encode()).digest()[:16]
            for seed, scenario_id, index in names
        )
        key = np.frombuffer(digests, dtype="<u8").reshape(-1, 2)
        return cls(key, np.zeros(len(key), dtype=np.int64))

    def __len__(self) -> int:
        return len(self.key)

    def take(self, places: Int64[np.ndarray, " kept"]) -> "Streams":
        """Keep some of them."""
        return Streams(self.key[places], self.begun[places])

    def put(
        self, places: Int64[np.ndarray, " replaced"], others: "Streams", token: int
    ) -> "Streams":
        """Replace some by others, which begin at a token step of the batch."""
        key, begun = self.key.copy(), self.begun.copy()
        key[places], begun[places] = others.key, token
        return Streams(key, begun)

    def uniform(
        self, token: int, purpose: Purpose, count: int, turn: int = 0
    ) -> Float64[np.ndarray, "stream count"]:
        """Draw numbers in [0, 1): the same for the same arguments, always.

        Args:
            token: Token step of the batch that the draw is made in. It counts from where
                each rollout began.
            purpose: What it decides.
            count: How many per stream; a longer draw starts with the shorter one.
            turn: Which draw of that purpose in this token step (the n-th inserted agent).
        """
        blocks = -(-count // WORDS)
        # The lowest word counts within a draw, from 1 on; the others name the draw.
        block = np.arange(1, blocks + 1, dtype=np.uint64)[None]
        own = (token - self.begun)[:, None]
        words = _philox((block, turn, own, int(purpose)), self.key)
        numbers = words.reshape(len(self), -1)[:, :count] >> _UNUSED_BITS
        return numbers * 2.0**-53


def _philox(
    counter: tuple[UInt64[np.ndarray, "1 block"], int, Int64[np.ndarray, "stream 1"], int],
    key: UInt64[np.ndarray, "stream 2"],
) -> UInt64[np.ndarray, "stream block 4"]:
    """Evaluate the generator for every key and every block of the counter."""
    shape = (len(key), counter[0].shape[1])
    first, second, third, fourth = (
        np.broadcast_to(np.asarray(word, dtype=np.uint64), shape) for word in counter
    )
    low, high = key[:, :1], key[:, 1:]
    for _ in range(ROUNDS):
        top_first, bottom_first = _multiply(first, _MULTIPLIERS[0])
        top_third, bottom_third = _multiply(third, _MULTIPLIERS[1])
        first, second = top_third ^ second ^ low, bottom_third
        third, fourth = top_first ^ fourth ^ high, bottom_first
        low, high = low + _KEY_STEPS[0], high + _KEY_STEPS[1]
    return np.stack([first, second, third, fourth], axis=-1)


def _multiply(word: np.ndarray, by: np.uint64) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper and the lower 64 bits of products of 64-bit words."""
    low, high = word & _LOW, word >> _HALF
    by_low, by_high = by & _LOW, by >> _HALF
    middle = high * by_low + (low * by_low >> _HALF)
    crossed = low * by_high + (middle & _LOW)
    return high * by_high + (middle >> _HALF) + (crossed >> _HALF), word * by
