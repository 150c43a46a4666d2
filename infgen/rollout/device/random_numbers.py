"""The random numbers of ``infgen.rollout.random_streams``, made on a device.

Philox on signed 64-bit integers: products and sums wrap alike, and shifts to the right are
masked. The numbers are the same bits.
"""

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from infgen.rollout.random_streams import KEY_STEPS, MULTIPLIERS, ROUNDS, Streams

_LOW, _HALF = 0xFFFFFFFF, 32
_UNUSED_BITS, _USED = 11, (1 << 53) - 1


class DeviceStreams:
    """The random streams of some rollouts on a device.

    Holds what does not change between draws: keys and multipliers of all rounds.
    """

    def __init__(self, streams: Streams, device: torch.device) -> None:
        """Bring random streams to a device."""
        self._begun = torch.from_numpy(streams.begun).to(device)
        signed = streams.key.view(np.int64).T[:, :, None]  # [word, stream, 1]
        steps, by = KEY_STEPS.view(np.int64), MULTIPLIERS.view(np.int64)
        keys = np.stack([signed + turn * steps for turn in range(ROUNDS)])
        halves = np.stack([by & _LOW, by >> _HALF & _LOW], axis=-1)[..., None, :]
        # Every round leaves the two words that are multiplied in the other order.
        self._rounds = [
            tuple(
                torch.from_numpy(np.flip(x, 0).copy() if flipped else x.copy()).to(device)
                for x, flipped in ((keys[at], not at % 2), (by, at % 2), (halves, at % 2))
            )
            for at in range(ROUNDS)
        ]

    def uniform(
        self,
        block: Int64[Tensor, " draw"],
        turn: Int64[Tensor, " draw"],
        token: int,
        purpose: Int64[Tensor, " draw"],
    ) -> Float64[Tensor, "stream draw 4"]:
        """Draw the four numbers of each block, counted from 0, of each stream."""
        draws = len(self._begun), len(block)
        own = (token - self._begun)[:, None].expand(draws)
        multiplied = torch.stack([(block + 1).expand(draws), own])
        others = torch.stack([turn, purpose])[:, None].expand(2, *draws)
        for keys, by, halves in self._rounds:
            top, bottom = _multiply(multiplied, by, halves)
            multiplied, others = top ^ others.flip(0) ^ keys, bottom
        words = torch.stack([multiplied, others], dim=1).flatten(0, 1)  # In their order.
        used = (words >> _UNUSED_BITS) & _USED
        return used.movedim(0, -1).double() * 2.0**-53


def _multiply(word: Tensor, by: Tensor, halves: Tensor) -> tuple[Tensor, Tensor]:
    """Return the upper and the lower 64 bits of words times their multipliers."""
    products = _halves(word)[..., :, None] * halves  # [..., half of the word, of the other]
    low, high = _halves(products).unbind(-1)
    middle = high[..., 0, 0] + low[..., 0, 1] + low[..., 1, 0]
    top = products[..., 1, 1] + high[..., 0, 1] + high[..., 1, 0] + (middle >> _HALF)
    return top, word * by


def _halves(word: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape 2"]:
    """Split words into their lower and their upper 32 bits, as numbers of 64 bits."""
    return word.view(torch.int32).long().view(*word.shape, 2) & _LOW
