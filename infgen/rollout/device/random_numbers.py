"""The random numbers of ``infgen.rollout.random_streams``, made on a device.

Philox on signed 64-bit integers: products and sums wrap alike, and shifts to the right are
masked. The numbers are the same bits.
"""

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from infgen.rollout.random_streams import KEY_STEPS, MULTIPLIERS, ROUNDS, WORDS

_LOW, _HALF = 0xFFFFFFFF, 32
_UNUSED_BITS, _USED = 11, (1 << 53) - 1


class DeviceStreams:
    """The random streams of some rollouts on a device.

    Holds what does not change between draws: the keys of all rounds and the multipliers.
    """

    def __init__(self, key: np.ndarray, device: torch.device) -> None:
        """Bring the keys [stream, 2] of ``Streams`` to a device."""
        signed = key.view(np.int64).T[:, :, None]  # [word, stream, 1]
        steps = KEY_STEPS.view(np.int64)
        with np.errstate(over="ignore"):
            keys = np.stack([signed + turn * steps for turn in range(ROUNDS)])
        self._keys = torch.from_numpy(keys).to(device)
        by = torch.from_numpy(MULTIPLIERS.view(np.int64).copy()).to(device)
        self._by, self._by_low, self._by_high = by, by & _LOW, (by >> _HALF) & _LOW

    def uniform(
        self,
        block: Int64[Tensor, " draw"],
        turn: Int64[Tensor, " draw"],
        token: int,
        purpose: Int64[Tensor, " draw"],
    ) -> Float64[Tensor, "stream draw 4"]:
        """Draw the four numbers of each block, counted from 0, of each stream."""
        shape = (self._keys.shape[2], len(block))
        counter = torch.stack([block + 1, turn, torch.full_like(turn, token), purpose])
        counter = counter[:, None].expand(4, *shape)
        multiplied, others = counter[0::2], counter[1::2]
        for keys in self._keys:
            top, bottom = self._multiply(multiplied)
            multiplied = top.flip(0) ^ others ^ keys
            others = bottom.flip(0)
        words = torch.stack([multiplied, others], dim=1).flatten(0, 1)  # In their order.
        assert len(words) == WORDS
        used = (words >> _UNUSED_BITS) & _USED
        return used.movedim(0, -1).double() * 2.0**-53

    def _multiply(self, word: Tensor) -> tuple[Tensor, Tensor]:
        """Return the upper and the lower 64 bits of words times their multipliers."""
        low, high = word & _LOW, (word >> _HALF) & _LOW
        middle = high * self._by_low + (((low * self._by_low) >> _HALF) & _LOW)
        crossed = low * self._by_high + (middle & _LOW)
        top = high * self._by_high + ((middle >> _HALF) & _LOW)
        return top + ((crossed >> _HALF) & _LOW), word * self._by
