"""Random numbers that belong to a rollout, whatever runs beside it.

Every draw is keyed by (seed, scene, rollout, token, purpose) and made by a counter-based
generator, so a rollout does not change with the batch, the worker or the order of work.
The generator is Philox4x64-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1,
2, 3"), evaluated for all rollouts at once; its numbers are those of numpy's ``Philox``.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int64, UInt64

ROUNDS = 10
WORDS = 4
"""Numbers that one evaluation makes."""
_LOW, _HALF, _UNUSED_BITS = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(11)
MULTIPLIERS = np.array([0xD2E7470EE14C6C93, 0xCA5A826395121157], dtype=np.uint64)[
    :, None, None
]
"""Of the first and the third word of the counter; in halves below."""
_BY_LOW, _BY_HIGH = MULTIPLIERS & _LOW, MULTIPLIERS >> _HALF
KEY_STEPS = np.array([0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B], dtype=np.uint64)[
    :, None, None
]


class Purpose(IntEnum):
    """What a number decides."""

    MOTION_TOKEN = 0
    LEAVE = 1
    ADD = 2
    CELL = 3
    AGENT_TYPE = 4
    HEADING = 5
    PATTERN = 6
    OFFSET = 7
    RATE = 8


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
        block = np.arange(1, blocks + 1, dtype=np.uint64)
        words = _philox((block, turn, int(purpose)), token - self.begun, self.key)
        return _numbers(words.reshape(len(self), -1)[:, :count])

    def uniform_block(
        self,
        token: int,
        purposes: Sequence[Purpose],
        block: int | Int64[np.ndarray, " stream"],
        turn: int | Int64[np.ndarray, " stream"] = 0,
    ) -> Float64[np.ndarray, "purpose stream 4"]:
        """Return four consecutive numbers of each purpose's draw: one evaluation each.

        They are ``uniform(...)[:, WORDS * block : WORDS * (block + 1)]`` of each purpose,
        for a block and a turn that all streams share or that each has of its own.
        """
        kinds = np.array(purposes, dtype=np.uint64)
        counter = (1 + _by_stream(block), _by_stream(turn), kinds)
        words = _philox(counter, token - self.begun, self.key)
        return np.moveaxis(_numbers(words), 1, 0)

    def uniform_turns(
        self,
        token: int,
        purposes: Sequence[Purpose],
        turns: range,
    ) -> Float64[np.ndarray, "purpose stream turn 4"]:
        """Return the first four numbers of each purpose's draw in some turns.

        They are ``uniform_block(token, purposes, 0, turn)`` for each of the turns: one
        evaluation of many draws costs little more than of one.
        """
        kinds = np.repeat(np.array(purposes, dtype=np.uint64), len(turns))
        counter = (1, np.tile(np.array(turns, dtype=np.uint64), len(purposes)), kinds)
        words = _philox(counter, token - self.begun, self.key)
        numbers = _numbers(words).reshape(len(self), len(purposes), len(turns), WORDS)
        return np.moveaxis(numbers, 1, 0)


def _by_stream(word: int | np.ndarray) -> UInt64[np.ndarray, "_ 1"]:
    """Return a word of every stream, or of all of them, for all draws."""
    return np.asarray(word, dtype=np.uint64).reshape(-1, 1)


def _numbers(words: UInt64[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Make numbers in [0, 1) of random words."""
    return (words >> _UNUSED_BITS) * 2.0**-53


def _philox(
    counter: tuple[int | UInt64[np.ndarray, "..."], ...],
    token: Int64[np.ndarray, " stream"],
    key: UInt64[np.ndarray, "stream 2"],
) -> UInt64[np.ndarray, "stream draw 4"]:
    """Evaluate the generator for every key and every value of the counter.

    Args:
        counter: Its words but the third, lowest first: numbers, or one for every draw, of
            all streams [draw] or of each [stream, draw].
        token: Its third word, of every stream.
        key: Keys, their low words first.
    """
    shape = np.broadcast_shapes(*(np.shape(word) for word in counter), (len(key), 1))
    multiplied = np.empty((2, *shape), dtype=np.uint64)  # First and third word.
    others = np.empty_like(multiplied)
    multiplied[0], others[0], others[1] = counter
    multiplied[1] = token.astype(np.uint64)[:, None]
    keys = key.T[..., None]
    for _ in range(ROUNDS):
        top, bottom = _multiply(multiplied)
        multiplied = top[::-1] ^ others
        multiplied ^= keys
        others = bottom[::-1]
        keys = keys + KEY_STEPS
    return np.stack([multiplied[0], others[0], multiplied[1], others[1]], axis=-1)


def _multiply(word: UInt64[np.ndarray, "2 stream draw"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper and the lower 64 bits of words times their multipliers."""
    low, high = word & _LOW, word >> _HALF
    carried = low * _BY_LOW
    carried >>= _HALF
    middle = high * _BY_LOW
    middle += carried
    low *= _BY_HIGH
    low += middle & _LOW
    low >>= _HALF
    middle >>= _HALF
    high *= _BY_HIGH
    high += middle
    high += low
    return high, word * MULTIPLIERS
