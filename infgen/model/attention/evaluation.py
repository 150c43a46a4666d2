"""Weights of an attention block as evaluation uses them, made once until they change.

Shape letters as in ``layers``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.attention.neighbour_attention import PairWeights


class Affine(NamedTuple):
    """Weight and bias of a linear layer, or gain and shift of a norm."""

    weight: Tensor
    bias: Tensor

    @classmethod
    def of(cls, part: nn.Module) -> "Affine":
        """Take those of a layer or norm; averaged ones may stand in for its parameters."""
        return cls(getattr(part, "weight"), getattr(part, "bias"))  # noqa: B009

    def to(self, kind: torch.dtype) -> "Affine":
        """Return them in some precision."""
        return Affine(self.weight.to(kind), self.bias.to(kind))

    def linear(self, x: Tensor) -> Tensor:
        """Apply them as a linear layer."""
        return functional.linear(x, self.weight, self.bias)

    def norm(self, x: Tensor) -> Tensor:
        """Apply them as a norm over the last dimension."""
        return torch.layer_norm(x, self.weight.shape, self.weight, self.bias)


class EvaluationWeights(NamedTuple):
    """Weights of an attention block in evaluation, made once, with norms folded in.

    Attributes:
        own: From a normed target to its query, scaled, its part of the gate, and its own
            value [3 D, D].
        pairs: Of keys and values.
        gate: From what a target saw to the gate [D, D].
        out: From there to the update ...
        norm_out: ... and its norm.
        forward: The feed-forward part: norm, two linear layers, norm.
    """

    own: Affine
    pairs: PairWeights
    gate: Tensor
    out: Affine
    norm_out: Affine
    forward: tuple[Affine, Affine, Affine, Affine]


class KeptFold(NamedTuple):
    """What was made of weights, and of which.

    Attributes:
        weights: The weights ...
        versions: ... and how often each had been changed.
        device: Where they were.
        autocast: Whether products had half the bits.
        folded: What was made of them.
    """

    weights: tuple[Tensor, ...]
    versions: tuple[int, ...]
    device: torch.device
    autocast: bool
    folded: EvaluationWeights

    @classmethod
    def of(
        cls, weights: Sequence[Tensor], autocast: bool, folded: EvaluationWeights
    ) -> "KeptFold":
        """Keep what was made of weights."""
        versions = tuple(each._version for each in weights)
        return cls(tuple(weights), versions, weights[0].device, autocast, folded)

    def holds(self, first: Tensor, autocast: bool) -> bool:
        """Whether it is still so; ``first`` is the first of the weights as it is now."""
        if first is not self.weights[0] or first.device != self.device:
            return False
        if autocast != self.autocast:
            return False
        return self.versions == tuple(each._version for each in self.weights)
