"""One pass of a network over a batch: in which precision, and compiled or not.

Under bf16 only matrix products lose bits. Poses, distances and angles are float32 and never
multiplied as matrices; softmax and norms are brought to float32 by autocast, and outputs
here, so that all losses are computed in it.
"""

import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from infgen.config import TrainSettings
from infgen.model.batching.batch import Batch
from infgen.model.batching.tensors import in_float32
from infgen.model.device.index import BatchIndex
from infgen.model.logits import Outputs
from infgen.model.network import Network


class Pass:
    """A network's pass over batches, as the settings say."""

    def __init__(self, network: Network, settings: TrainSettings) -> None:
        self._network = network
        self._device = next(network.parameters()).device
        self._hidden_roads = settings.map_weight > 0
        self.bf16 = _wants_bf16(settings.precision, self._device)
        self._compiled: Callable[..., Outputs] | None = None
        if settings.compile == "true":
            self._compiled = torch.compile(network, dynamic=True)

    @property
    def compiled(self) -> bool:
        """Whether the network is compiled (as far as known: it happens at first use)."""
        return self._compiled is not None

    def __call__(self, batch: Batch, index: BatchIndex | None = None) -> Outputs:
        """Compute all outputs, for the loss: in float32."""
        with self._casting():
            return in_float32(self._forward(batch, index))

    def evaluated(self, network: Network, batch: Batch, insertions: bool = True) -> Outputs:
        """Compute the outputs of a network in evaluation mode: nothing is hidden."""
        with self._casting():
            outputs: Outputs = network(batch, insertions=insertions)
            return in_float32(outputs)

    def averaged(self, batch: Batch, average: Mapping[str, Tensor]) -> Outputs:
        """Compute all outputs with other parameters: those of a moving average."""
        wanted = {"hidden_roads": self._hidden_roads}
        with self._casting():
            outputs: Outputs = torch.func.functional_call(
                self._network, dict(average), (batch,), wanted
            )
            return in_float32(outputs)

    def _forward(self, batch: Batch, index: BatchIndex | None) -> Outputs:
        how = {"hidden_roads": self._hidden_roads, "index": index}
        if self._compiled is not None:
            from torch._dynamo.exc import TorchDynamoException  # noqa: PLC0415

            try:
                return self._compiled(batch, **how)
            except TorchDynamoException as error:  # Not a GPU that is out of memory.
                self._compiled = None
                why = str(error).strip().splitlines()[0]
                warnings.warn(f"going on without compiling: {why}", stacklevel=2)
        outputs: Outputs = self._network(batch, **how)
        return outputs

    def _casting(self) -> AbstractContextManager[object]:
        if not self.bf16:
            return nullcontext()
        return torch.autocast(self._device.type, torch.bfloat16)


def _wants_bf16(precision: str, device: torch.device) -> bool:
    if precision == "auto":
        return device.type == "cuda" and torch.cuda.is_bf16_supported()
    return precision == "bf16"
