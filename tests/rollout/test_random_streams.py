import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.random_streams import Purpose, Streams


def test_the_same_arguments_always_give_the_same_numbers():
    first = Streams.of([(7, "abc", 3)]).uniform(5, Purpose.MOTION_TOKEN, 10)
    again = Streams.of([(7, "abc", 3)]).uniform(5, Purpose.MOTION_TOKEN, 10)

    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(
    ("seed", "scene", "index", "token", "purpose", "turn"),
    [
        (8, "abc", 3, 5, Purpose.MOTION_TOKEN, 0),
        (7, "abd", 3, 5, Purpose.MOTION_TOKEN, 0),
        (7, "abc", 4, 5, Purpose.MOTION_TOKEN, 0),
        (7, "abc", 3, 6, Purpose.MOTION_TOKEN, 0),
        (7, "abc", 3, 5, Purpose.LEAVE, 0),
        (7, "abc", 3, 5, Purpose.MOTION_TOKEN, 1),
    ],
)
def test_every_part_of_the_key_changes_the_numbers(
    seed, scene, index, token, purpose, turn
):
    known = Streams.of([(7, "abc", 3)]).uniform(5, Purpose.MOTION_TOKEN, 100)
    other = Streams.of([(seed, scene, index)]).uniform(token, purpose, 100, turn)

    assert not np.isin(known, other).any()


def test_a_longer_draw_starts_with_the_shorter_one():
    stream = Streams.of([(0, "abc", 0)])

    np.testing.assert_array_equal(
        stream.uniform(1, Purpose.MOTION_TOKEN, 128)[:, :16],
        stream.uniform(1, Purpose.MOTION_TOKEN, 16),
    )


def test_draws_of_a_batch_are_those_of_its_members():
    names = [(0, "abc", index) for index in range(3)]

    batch = Streams.of(names).uniform(4, Purpose.ADD, 2)

    alone = Streams.of(names[1:2]).uniform(4, Purpose.ADD, 2)
    np.testing.assert_array_equal(batch[1:2], alone)
    np.testing.assert_array_equal(
        Streams.of(names).take(np.array([1])).uniform(4, Purpose.ADD, 2), alone
    )


def test_each_stream_may_be_at_a_block_and_a_turn_of_its_own():
    streams, purposes = Streams.of([(0, "abc", n) for n in range(3)]), list(Purpose)
    block, turn = np.array([0, 2, 1]), np.array([5, 0, 3])

    found = streams.uniform_block(4, purposes, block, turn)

    for number in range(3):
        own = streams.take(np.array([number]))
        alone = own.uniform_block(4, purposes, int(block[number]), int(turn[number]))
        np.testing.assert_array_equal(found[:, [number]], alone)


def test_turns_drawn_together_are_those_drawn_one_by_one():
    streams, purposes = Streams.of([(0, "abc", n) for n in range(3)]), list(Purpose)

    found = streams.uniform_turns(4, purposes, range(8, 12))

    for place, turn in enumerate(range(8, 12)):
        alone = streams.uniform_block(4, purposes, 0, turn)
        np.testing.assert_array_equal(found[:, :, place], alone)


@given(
    index=st.integers(0, 2**31),
    token=st.integers(0, 2**31),
    purpose=st.sampled_from(Purpose),
    turn=st.integers(0, 2**31),
    count=st.integers(1, 20),
)
def test_numbers_are_those_of_the_generator_of_numpy(index, token, purpose, turn, count):
    digest = hashlib.sha256(f"7/abc/{index}".encode()).digest()[:16]
    generator = np.random.Philox(
        key=int.from_bytes(digest, "little"), counter=[0, turn, token, int(purpose)]
    )

    numbers = Streams.of([(7, "abc", index)]).uniform(token, purpose, count, turn)

    np.testing.assert_array_equal(numbers[0], np.random.Generator(generator).random(count))


def test_numbers_are_even():
    numbers = Streams.of([(0, "even", 0)]).uniform(0, Purpose.MOTION_TOKEN, 100_000)

    counts, _ = np.histogram(numbers, bins=10, range=(0, 1))
    assert abs(counts - 10_000).max() < 500
