"""A batch in one piece of memory: one file descriptor, one copy to a GPU.

Tensor by tensor, a batch is some fifty copies and as many waits for them.
"""

from dataclasses import dataclass
from math import prod

import torch
from jaxtyping import UInt8
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.batching.supervision import Supervision
from infgen.model.batching.tensors import map_tensors
from infgen.model.device.index import BatchIndex

ALIGNED_BYTES = 16
"""Tensors begin at multiples of this, as products on GPUs want them to."""


@dataclass(frozen=True, slots=True)
class IndexedBatch:
    """A batch, and the places of it that hold something.

    Attributes:
        batch: The batch.
        index: The places; None to find them where the batch is.
        supervision: What is supervised of it; None likewise.
    """

    batch: Batch
    index: BatchIndex | None
    supervision: Supervision | None


@dataclass(frozen=True, slots=True)
class PackedBatch:
    """A batch and its index, byte after byte.

    Attributes:
        values: All tensors, one after the other.
        layout: The record that they make, of tensors without values.
    """

    values: UInt8[Tensor, " byte"]
    layout: IndexedBatch

    @classmethod
    def of(cls, batch: Batch) -> "PackedBatch":
        """Pack a batch on the CPU. Inverse of ``unpack``."""
        parts: list[Tensor] = []

        def lay(tensor: Tensor) -> Tensor:
            parts.append(tensor.contiguous().flatten().view(torch.uint8))
            parts.append(torch.zeros(_gap(parts[-1].numel()), dtype=torch.uint8))
            return torch.empty_like(tensor, device="meta")

        layout = map_tensors(
            IndexedBatch(batch, BatchIndex.of(batch), Supervision.of(batch)), lay
        )
        return cls(torch.cat(parts), layout)

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """Of its scenes."""
        return self.layout.batch.scenario_ids

    def pin(self) -> "PackedBatch":
        """Put it in memory that a GPU can copy from by itself."""
        return PackedBatch(self.values.pin_memory(), self.layout)

    def unpack(self, device: torch.device) -> IndexedBatch:
        """Make the batch anew on a device, of one copy."""
        values, begin = self.values.to(device, non_blocking=True), 0

        def cut(like: Tensor) -> Tensor:
            nonlocal begin
            length = prod(like.shape) * like.element_size()
            part = values[begin : begin + length]
            begin += length + _gap(length)
            return part.view(like.dtype).view(like.shape)

        return map_tensors(self.layout, cut)


def prepared(part: Batch | PackedBatch, device: torch.device) -> IndexedBatch:
    """Bring a batch to a device, however it comes."""
    if isinstance(part, PackedBatch):
        return part.unpack(device)
    return IndexedBatch(map_tensors(part, lambda x: x.to(device)), None, None)


def _gap(length: int) -> int:
    """Bytes from the end of a tensor to the begin of the next."""
    return -length % ALIGNED_BYTES
