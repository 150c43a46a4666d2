"""The tables of many families of relations, evaluated with a few launches."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.relation_tables import RelationEmbedding

PADDED = 2
"""Scalars are evaluated together if the longest has up to so many times as many nodes."""


class _Scalar(NamedTuple):
    """One scalar of one embedding."""

    embedding: RelationEmbedding
    number: int

    @property
    def nodes(self) -> int:
        return self.embedding.spans[self.number].nodes

    @property
    def closed(self) -> bool:
        return self.embedding.spans[self.number].closed

    @property
    def group(self) -> tuple[bool, int]:
        """Scalars of one group are evaluated together."""
        size = self.nodes if self.closed else int(math.log(self.nodes, PADDED))
        return self.closed, size


@contextmanager
def tables_together(embeddings: Sequence[RelationEmbedding]) -> Iterator[None]:
    """Evaluate the tables of embeddings, which give them as long as this lasts."""
    try:
        for embedding, table in zip(embeddings, _tables(embeddings), strict=True):
            embedding.evaluated = table
        yield
    finally:
        for embedding in embeddings:
            embedding.evaluated = None


def _tables(embeddings: Sequence[RelationEmbedding]) -> list[Tensor]:
    scalars = [_Scalar(each, i) for each in embeddings for i in range(len(each.spans))]
    values: dict[tuple[int, int], Tensor] = {}
    ordered = sorted(((each.group, at) for at, each in enumerate(scalars)))
    device = embeddings[0].frequency.weight.device
    with torch.autocast(device.type, enabled=False):
        for _, group in groupby(ordered, key=itemgetter(0)):
            some = [scalars[at] for _, at in group]
            found = _evaluate(some).unbind()
            for scalar, table in zip(some, found, strict=True):
                values[id(scalar.embedding), scalar.number] = table[: scalar.nodes]
        return [
            torch.cat([values[id(each), i] for i in range(len(each.spans))])
            for each in embeddings
        ]


def _evaluate(scalars: Sequence[_Scalar]) -> Tensor:
    """Values [scalar, node, D] at the nodes; what is beyond a scalar's nodes is padding."""
    most = max(scalar.nodes for scalar in scalars)
    heads = [list(each.embedding.scalars[each.number].children()) for each in scalars]
    at = torch.stack([s.embedding.padded_nodes(s.number, most) for s in scalars])
    frequency = torch.stack([s.embedding.frequency.weight[s.number] for s in scalars])
    phase = (2 * math.pi * at[..., None]) * frequency[:, None]
    waves = torch.cat([phase.cos(), phase.sin(), at[..., None]], dim=-1)
    first, norm, _, last = zip(*heads, strict=True)
    hidden = _linear(first, waves)
    normal = functional.layer_norm(hidden, hidden.shape[-1:])
    gain = torch.stack([each.get_parameter("weight") for each in norm])[:, None]
    shift = torch.stack([each.get_parameter("bias") for each in norm])[:, None]
    values = _linear(last, torch.addcmul(shift, normal, gain).relu())
    if not scalars[0].closed:
        return values
    middle = (values[:, :1] + values[:, -1:]) / 2
    return torch.cat([middle, values[:, 1:-1], middle], dim=1)


def _linear(layers: Sequence[nn.Module], values: Tensor) -> Tensor:
    weight = torch.stack([layer.get_parameter("weight") for layer in layers])
    bias = torch.stack([layer.get_parameter("bias") for layer in layers])
    return torch.baddbmm(bias[:, None], values, weight.mT)
