"""Precision of the network in rollouts.

Matrix products alone lose bits: poses, distances and neighbours are never computed as
matrix products, relations are looked up with autocast off, and the stepper computes logits
with autocast off.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Literal

import torch
from torch import Tensor

from infgen.model.batching.tensors import in_float32
from infgen.model.insertion.detail_query import InsertionDetails
from infgen.model.neighbours import MapFeatures
from infgen.model.network import Network
from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.stepping import Stepper
from infgen.model.token_step import MotionStep, PositionOutputs

Precision = Literal["auto", "float32", "bf16"]


def make_stepper(network: Network, precision: Precision) -> Stepper:
    """Return the stepper of a network, on its device, in a precision.

    Args:
        network: The network.
        precision: As ``RolloutSettings.precision``.
    """
    device_type = next(network.parameters()).device.type
    if device_type == "cpu" and precision != "bf16":
        return Stepper(network)
    return PrecisionStepper(network, precision)


def describe_precision(precision: Precision, device_type: str) -> str:
    """Name the precision of matrix products: ``float32``, ``TF32`` or ``bf16``."""
    if precision == "auto":
        return "TF32" if device_type == "cuda" else "float32"
    return precision


class PrecisionStepper(Stepper):
    """A stepper whose matrix products have a precision of their own.

    Tables are made in float32, before; what is asked of it is answered in float32.
    """

    def __init__(self, network: Network, precision: Precision) -> None:
        super().__init__(network)
        self._precision = precision
        self._device_type = next(network.parameters()).device.type

    def begin(self, *args: Any, **named: Any) -> StepMemory:
        """Encode maps and start with an empty past."""
        with self._context_of_products():
            return in_float32(super().begin(*args, **named))

    def encode_maps(self, *args: Any, **named: Any) -> Tensor:
        """Return what every map token is, map after map."""
        with self._context_of_products():
            return super().encode_maps(*args, **named).float()

    def lay_out_maps(self, *args: Any, **named: Any) -> MapFeatures:
        """Put maps side by side that were encoded before."""
        with self._context_of_products():
            return in_float32(super().lay_out_maps(*args, **named))

    def begin_on(self, *args: Any, **named: Any) -> StepMemory:
        """Start with an empty past on encoded maps; no product is made."""
        return super().begin_on(*args, **named)

    def motion_step(self, *args: Any, **named: Any) -> MotionStep:
        """Append a column to the past and say what follows it."""
        with self._context_of_products():
            return in_float32(super().motion_step(*args, **named))

    def entry_begin(self, *args: Any, **named: Any) -> Insertions:
        """Look at the map and the agents around the ego, before any inserted agent."""
        with self._context_of_products():
            return in_float32(super().entry_begin(*args, **named))

    def entry_add(self, *args: Any, **named: Any) -> Insertions:
        """Go on with inserted agents as further visible rows of the same column."""
        with self._context_of_products():
            return in_float32(super().entry_add(*args, **named))

    def entry_query(self, *args: Any, **named: Any) -> PositionOutputs:
        """Ask for the next inserted agent of every rollout."""
        with self._context_of_products():
            return in_float32(super().entry_query(*args, **named))

    def entry_details(self, *args: Any, **named: Any) -> InsertionDetails:
        """Query the details of an inserted agent at a cell of every rollout."""
        with self._context_of_products():
            return in_float32(super().entry_details(*args, **named))

    def _context_of_products(self) -> AbstractContextManager[object]:
        if self._precision == "bf16":
            return torch.autocast(self._device_type, torch.bfloat16)
        if self._device_type != "cuda":
            return nullcontext()
        return _tf32(allowed=self._precision == "auto")


@contextmanager
def _tf32(*, allowed: bool) -> Iterator[None]:
    """Allow TF32 products on CUDA devices, or not; put back in the end, as it is global."""
    before = torch.get_float32_matmul_precision()
    convolutions = torch.backends.cudnn.allow_tf32
    torch.set_float32_matmul_precision("high" if allowed else "highest")
    torch.backends.cudnn.allow_tf32 = allowed
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
        torch.backends.cudnn.allow_tf32 = convolutions
