"""Numbers made on a device are the very bits of those made on the host."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.device.random_numbers import DeviceStreams
from infgen.rollout.random_streams import Purpose, Streams


@given(
    seed=st.integers(0, 2**31),
    token=st.integers(0, 2**31),
    turn=st.integers(0, 2**31),
    block=st.integers(0, 1000),
)
def test_blocks_are_those_of_the_host(seed, token, turn, block):
    streams = Streams.of([(seed, "abc", index) for index in range(3)])
    purposes = (Purpose.ADD, Purpose.HEADING)
    device = DeviceStreams(streams, torch.device("cpu"))

    ours = device.uniform(
        torch.full((2,), block), torch.full((2,), turn), token, torch.tensor(purposes)
    )

    expected = streams.uniform_block(token, purposes, block, turn)
    np.testing.assert_array_equal(ours.numpy(), np.moveaxis(expected, 0, 1))


def test_a_block_is_part_of_a_longer_draw():
    streams = Streams.of([(0, "abc", 0), (0, "abc", 1)])

    (block,) = streams.uniform_block(5, [Purpose.CELL], 2, turn=3)

    longer = streams.uniform(5, Purpose.CELL, 16, turn=3)
    np.testing.assert_array_equal(block, longer[:, 8:12])
