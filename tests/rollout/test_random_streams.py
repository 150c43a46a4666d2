import numpy as np
import pytest

from infgen.rollout.random_streams import Purpose, Stream, draw_uniforms


def test_the_same_arguments_always_give_the_same_numbers():
    first = Stream.of(7, "abc", 3).uniform(5, Purpose.MOTION_TOKEN, 10)
    again = Stream.of(7, "abc", 3).uniform(5, Purpose.MOTION_TOKEN, 10)

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
    known = Stream.of(7, "abc", 3).uniform(5, Purpose.MOTION_TOKEN, 100)
    other = Stream.of(seed, scene, index).uniform(token, purpose, 100, turn)

    assert not np.isin(known, other).any()


def test_a_longer_draw_starts_with_the_shorter_one():
    stream = Stream.of(0, "abc", 0)

    np.testing.assert_array_equal(
        stream.uniform(1, Purpose.MOTION_TOKEN, 128)[:16],
        stream.uniform(1, Purpose.MOTION_TOKEN, 16),
    )


def test_draws_of_a_batch_are_those_of_its_members():
    streams = [Stream.of(0, "abc", index) for index in range(3)]

    batch = draw_uniforms(streams, 4, Purpose.ADD, 2)

    np.testing.assert_array_equal(batch[1], streams[1].uniform(4, Purpose.ADD, 2))


def test_numbers_are_even():
    numbers = Stream.of(0, "even", 0).uniform(0, Purpose.MOTION_TOKEN, 100_000)

    counts, _ = np.histogram(numbers, bins=10, range=(0, 1))
    assert abs(counts - 10_000).max() < 500
