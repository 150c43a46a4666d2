"""Which scenes a training step reads follows from its number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.stages.train.sampler import ScenePermutation


def order(sizes, batch=3, pool=1, seed=5):
    """Scenes of these sizes; if only one is given the other is the same for all."""
    sizes = np.asarray(sizes, np.int64)
    if sizes.ndim == 1:
        sizes = np.column_stack([0 * sizes, sizes])
    return ScenePermutation(sizes, batch, pool, seed)


@given(
    count=st.integers(1, 40),
    batch=st.integers(1, 9),
    pool=st.integers(1, 5),
    seed=st.integers(0, 3),
)
def test_every_epoch_visits_every_scene_once(count, batch, pool, seed):
    reads = order(np.arange(count)[::-1], batch, pool, seed)

    steps = [reads.scenes(step) for step in range(-(-3 * count // batch))]

    assert all(len(step) == batch for step in steps)
    flat = [row for step in steps for row in step]
    for epoch in range(3):
        assert sorted(flat[epoch * count : (epoch + 1) * count]) == list(range(count))


def test_epochs_and_seeds_differ_and_the_same_again_is_the_same():
    sizes = np.arange(64) % 8
    visits = [order(sizes, batch=8, pool=4).scenes(step) for step in range(16)]

    assert visits[:8] != visits[8:]
    assert visits != [order(sizes, 8, 4, seed=6).scenes(step) for step in range(16)]
    assert visits == [order(sizes, 8, 4).scenes(step) for step in range(16)]


def test_a_batch_holds_scenes_of_about_one_size():
    sizes = np.random.default_rng(0).permutation(64)

    spans = [np.ptp(sizes[order(sizes, 8, pool=8).scenes(step)]) for step in range(8)]

    assert spans == [7] * 8  # 64 different sizes in eight batches: eight neighbours each.
    mixed = [np.ptp(sizes[order(sizes, 8, pool=1).scenes(step)]) for step in range(8)]
    assert min(mixed) > 7


def test_both_sizes_are_alike_in_a_batch():
    agents, roads = np.divmod(np.random.default_rng(0).permutation(256), 16)
    sizes = np.column_stack([agents, roads])

    steps = [sizes[order(sizes, 16, pool=16).scenes(step)] for step in range(16)]

    # Four strips of four: each batch is one of 16 squares of the 16 by 16 kinds of scenes.
    assert {tuple(np.ptp(step, axis=0)) for step in steps} == {(3, 3)}


def test_batches_of_one_size_come_in_any_order():
    sizes = np.arange(64)

    firsts = [sizes[order(sizes, 8, pool=8).scenes(step)].min() for step in range(8)]

    assert sorted(firsts) == list(range(0, 64, 8))
    assert firsts != sorted(firsts)


@pytest.mark.parametrize("pool", [1, 4])
def test_batches_larger_than_the_data_wrap_around(pool):
    assert sorted(order([1, 2], batch=5, pool=pool).scenes(0)[:4]) == [0, 0, 1, 1]


@given(count=st.integers(2, 40), batch=st.integers(1, 5), pool=st.integers(1, 4))
def test_steps_that_are_left_out_are_those_that_were_read_before(count, batch, pool):
    sizes = np.zeros((count, 2), np.int64)
    whole = ScenePermutation(sizes, batch, pool, 3)
    later = ScenePermutation(sizes, batch, pool, 3, skip=7)

    assert [later.scenes(step) for step in range(9)] == [
        whole.scenes(step) for step in range(7, 16)
    ]


def test_the_scenes_that_are_read_are_as_many_as_asked_for_and_of_the_seed():
    sizes = np.zeros((60, 2), np.int64)

    def read(most, seed=1):
        reads = ScenePermutation(sizes, 4, 1, seed, most=most)
        steps = [reads.scenes(step) for step in range(reads.epoch_scenes)]
        return {row for step in steps for row in step}

    assert [len(read(most)) for most in (0, 8, 24, 60, 99)] == [60, 8, 24, 60, 60]
    assert read(8) < read(24)  # Fewer are among more.
    assert read(8, seed=2) != read(8)
