"""Random numbers of insertion turns are those of each turn and attempt by itself."""

import numpy as np

from infgen.rollout.insertion_state import (
    TURN_PURPOSES,
    TURNS_AT_ONCE,
    Attempts,
    TurnNumbers,
)
from infgen.rollout.random_streams import Streams

TOKEN = 7


def test_every_rollout_gets_the_numbers_of_the_turn_and_the_attempt_it_is_at():
    streams = Streams.of([(0, "abc", n) for n in range(4)])
    numbers = TurnNumbers.of(streams, TOKEN)
    turn, attempt = np.zeros(4, dtype=np.int64), np.zeros(4, dtype=np.int64)
    random, active = np.random.default_rng(0), np.arange(4)
    for _ in range(40):
        numbers.draw(active, turn[active], attempt[active])
        found = numbers.get(active, turn[active], attempt[active])
        for place, rollout in enumerate(active):
            own = streams.take(np.array([rollout]))
            for purpose, number in zip(TURN_PURPOSES, found[:, place], strict=True):
                count = int(attempt[rollout]) + 1
                draw = own.uniform(TOKEN, purpose, count, int(turn[rollout]))
                assert number == draw[0, -1]
        placed = random.random(4) < 0.4
        turn, attempt = turn + placed, np.where(placed, 0, attempt + 1)
        active = np.flatnonzero(turn < 2 * TURNS_AT_ONCE + np.arange(4))
        if not len(active):
            break
    assert turn.max() > TURNS_AT_ONCE
    assert attempt.max() > 0


def attempts():
    """Three attempts of rollout 5, one of rollout 8, two of rollout 9."""
    return Attempts(
        rollout=np.array([5, 5, 5, 8, 9, 9]),
        count=np.array([3, 1, 2]),
        of=np.array([0, 0, 0, 1, 2, 2]),
        rank=np.array([0, 1, 2, 0, 0, 1]),
        numbers=np.zeros((len(TURN_PURPOSES), 6)),
    )


def test_the_first_allowed_attempt_of_each_rollout_is_taken():
    allowed = np.array([False, True, True, False, True, True])
    assert attempts().first(allowed).tolist() == [1, -1, 4]


def test_attempts_are_made_rank_by_rank():
    ranks = [places.tolist() for places in attempts().by_rank()]
    assert ranks == [[0, 3, 4], [1, 5], [2]]
