"""The tables of many families of relations, evaluated with a few launches.

Shape letters: S scalars, P nodes of the longest of them, D width, B frequencies; rows are
the nodes of all scalars of a group, one after the other, the shorter ones padded.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from infgen.model.relation_tables import RelationEmbedding, Span

PADDING_NODES = 1 << 14
"""Scalars are evaluated together if shorter ones are padded by no more nodes in all."""


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


@dataclass(frozen=True, slots=True)
class _Plan:
    """Which scalars are evaluated together, and where their values belong.

    Attributes:
        order: Place of each scalar, the longest first, among those of all embeddings [S].
        number: The same places, for the host.
        at: Where the nodes of each group's scalars are [S, P].
        rows: The two rows, mostly the same, whose mean is a row of the tables [row, 2]: the
            ends of a closed scalar mean the same.
        nodes: Of each embedding's table.
    """

    order: Tensor
    number: tuple[int, ...]
    at: tuple[Tensor, ...]
    rows: Tensor
    nodes: tuple[int, ...]

    @classmethod
    def of(cls, spans: Sequence[Sequence[Span]], device: torch.device) -> "_Plan":
        """Plan for embeddings of some spans."""
        flat = [span for each in spans for span in each]
        order = sorted(range(len(flat)), key=lambda at: -flat[at].nodes)
        at, row = [], 0
        starts: dict[int, int] = {}
        for group in _groups(order, [span.nodes for span in flat]):
            most = flat[group[0]].nodes
            at.append(torch.stack([_padded(flat[each], most) for each in group]).to(device))
            starts |= {each: row + most * place for place, each in enumerate(group)}
            row += most * len(group)
        rows = torch.cat([starts[each] + _ends(span) for each, span in enumerate(flat)])
        nodes = tuple(sum(span.nodes for span in each) for each in spans)
        there = torch.tensor(order).to(device)
        return cls(there, tuple(order), tuple(at), rows.to(device), nodes)


_plan = lru_cache(maxsize=8)(_Plan.of)


def _groups(order: Sequence[int], nodes: Sequence[int]) -> list[list[int]]:
    """Cut scalars, the longest first, into groups that need little padding."""
    groups: list[list[int]] = []
    padding = 0
    for each in order:
        more = nodes[groups[-1][0]] - nodes[each] if groups else 0
        if not groups or padding + more > PADDING_NODES:
            groups.append([])
            padding = more = 0
        groups[-1].append(each)
        padding += more
    return groups


def _padded(span: Span, count: int) -> Tensor:
    """Where the nodes of a scalar are [count], the last one repeated."""
    at = torch.linspace(span.first, span.last, span.nodes)
    return functional.pad(at, (0, count - span.nodes), value=span.last)


def _ends(span: Span) -> Tensor:
    """The two nodes whose mean each node's value is [node, 2]."""
    both = torch.arange(span.nodes)[:, None].repeat(1, 2)
    if span.closed:
        both[[0, -1]] = torch.tensor([0, span.nodes - 1])
    return both


def _tables(embeddings: Sequence[RelationEmbedding]) -> list[Tensor]:
    frequencies = torch.cat([each.frequency.weight for each in embeddings])
    plan = _plan(tuple(each.spans for each in embeddings), frequencies.device)
    heads = [head for each in embeddings for head in each.scalars]
    layers = [list(heads[at].children()) for at in plan.number]
    first, norm, _, last = zip(*layers, strict=True)
    counts = [len(at) for at in plan.at]
    with torch.autocast(frequencies.device.type, enabled=False):
        frequency = functional.embedding(plan.order, frequencies)
        weights = [
            torch.stack([layer.get_parameter(name) for layer in some])
            for some in (first, norm, last)
            for name in ("weight", "bias")
        ]
        cut = zip(*(torch.split(x, counts) for x in (frequency, *weights)), strict=True)
        found = [_evaluate(at, *each) for at, each in zip(plan.at, cut, strict=True)]
        values = torch.cat([each.flatten(0, 1) for each in found])
        tables = functional.embedding_bag(plan.rows, values, mode="mean")
    return list(torch.split(tables, list(plan.nodes)))


def _evaluate(
    at: Tensor,
    frequency_SB: Tensor,
    weight: Tensor,
    bias_SD: Tensor,
    gain_SD: Tensor,
    shift_SD: Tensor,
    out: Tensor,
    out_bias_SD: Tensor,
) -> Tensor:
    """Values [S, P, D] at nodes [S, P]: the same layers for each scalar."""
    phase = (2 * math.pi * at[..., None]) * frequency_SB[:, None]
    waves = torch.cat([phase.cos(), phase.sin(), at[..., None]], dim=-1)
    hidden = torch.baddbmm(bias_SD[:, None], waves, weight.mT)
    normal = functional.layer_norm(hidden, hidden.shape[-1:])
    scaled = torch.addcmul(shift_SD[:, None], normal, gain_SD[:, None])
    return torch.baddbmm(out_bias_SD[:, None], scaled.relu(), out.mT)
