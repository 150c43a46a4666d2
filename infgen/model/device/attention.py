"""One attention block with fewer launches, for training on a GPU.

``layers.Attention`` is written for a CPU, where a launch costs nothing and its cache is
small. A GPU has the whole of a batch at once: weights are folded for all blocks together,
queries for features and relations come from one product, and so do values, and dropout is
drawn where weights are. Values are those of ``layers.Attention`` but for rounding.

Under autocast scores and weights, and the sum of all layers' gradients of relations, are
float32; only products have half the bits.

Shape letters as in ``neighbour_attention``; E the width of what a query sees: D, R, the sum
of its weights, and zeros that keep rows aligned.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from infgen.model.layers import Attention, AttentionSources
from infgen.model.neighbour_attention import HIDDEN_SCORE, Shared
from infgen.model.rotary.turns import turned, turned_back

ALIGNED = 8
"""Columns that hold the sum of the weights, and zeros."""
FULL_BYTES = 4
"""Of a float32; numbers of fewer bytes are products only."""


class Folded(NamedTuple):
    """Weights of a block with its norms folded in.

    Attributes:
        query: From a head of a query to features and relations [H, C, D + R].
        value: From what a query sees to a head of its value [H, E, C].
        gate: From what a target saw and is to its gate and itself [2 D, 2 D] ...
        gate_bias: ... and their biases.
    """

    query: Tensor
    value: Tensor
    gate: Tensor
    gate_bias: Tensor


@contextmanager
def folded_together(blocks: Sequence[Attention]) -> Iterator[None]:
    """Let blocks of one shape be evaluated by ``attend``, their weights folded at once."""
    try:
        for block, folded in zip(blocks, _fold(blocks), strict=True):
            block.fused = lambda target, seen, block=block, folded=folded: attend(
                block, folded, target, seen
            )
        yield
    finally:
        for block in blocks:
            block.fused = None


def _fold(blocks: Sequence[Attention]) -> list[Folded]:
    sources = [block.source_norm() for block in blocks]
    relations = [block.norm_relation for block in blocks]
    width, heads = blocks[0].query.in_features, blocks[0].heads
    both = (sources, relations)
    gain, shift = (
        torch.cat([torch.stack([getattr(x, name) for x in norms]) for norms in both], dim=1)
        for name in ("weight", "bias")
    )
    query, value = (
        torch.cat([torch.stack([getattr(b, x).weight for b in blocks]) for x in pair], 2)
        for pair in (("key", "relation_key"), ("value", "relation_value"))
    )
    own = torch.stack([block.value.bias for block in blocks])
    bias = torch.baddbmm(own[..., None], value, shift[..., None])
    scaled = gain * (width // heads) ** -0.5
    value = functional.pad(
        torch.cat([value * gain[:, None], bias], dim=2), (0, ALIGNED - 1)
    )
    shape = (len(blocks), heads, width // heads, -1)
    gate = torch.stack([block.gate.weight for block in blocks])
    itself = functional.pad(
        torch.stack([block.itself.weight for block in blocks]), (width, 0)
    )
    parts = (
        (query * scaled[:, None]).view(shape),
        value.view(shape).mT,
        torch.cat([gate, itself], dim=1),
        torch.stack([torch.cat([b.gate.bias, b.itself.bias]) for b in blocks]),
    )
    return [Folded(*each) for each in zip(*(x.unbind() for x in parts), strict=True)]


def attend(
    block: Attention, folded: Folded, target: Tensor, seen: AttentionSources
) -> Tensor:
    """Update targets [N, D] or [N, S, D] as the block does."""
    slots = target if target.dim() == 3 else target[:, None]
    normal = block.norm_target(slots)
    looked = _look(block, folded, normal, seen)
    update = _Gate.apply(  # type: ignore[no-untyped-call]
        looked.flatten(0, 1), normal.flatten(0, 1), folded.gate, folded.gate_bias
    ).view_as(slots)
    slots = slots + block.norm_out(block.out(update))
    slots = slots + block.feed_forward(slots)
    return slots.view_as(target)


class _Gate(torch.autograd.Function):
    """Between what targets saw [N, D] and what they are themselves, as a gate says."""

    @staticmethod
    def forward(
        ctx: Any, looked: Tensor, normal: Tensor, weight: Tensor, bias: Tensor
    ) -> Tensor:
        kind = looked.dtype
        both = torch.cat([looked, normal.to(kind)], dim=1)
        weight = weight.to(kind)
        gate, itself = torch.addmm(bias.to(kind), both, weight.T).chunk(2, dim=1)
        gate = gate.sigmoid()
        ctx.save_for_backward(both, weight, gate, itself)
        return torch.lerp(looked, itself, gate)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor, ...]:
        both, weight, gate, itself = ctx.saved_tensors
        width = pull.shape[1]
        through = pull.new_empty((len(pull), 2 * width))
        torch.mul(pull, gate, out=through[:, width:])
        opened = (itself - both[:, :width]).mul_(pull)
        torch.ops.aten.sigmoid_backward(opened, gate, grad_input=through[:, :width])
        to_both = through @ weight
        to_both[:, :width] += pull
        to_both[:, :width] -= through[:, width:]
        to_looked, to_normal = to_both.chunk(2, dim=1)
        return to_looked, to_normal, through.T @ both, through.sum(dim=0)


def _look(
    block: Attention, folded: Folded, normal_NSD: Tensor, seen: AttentionSources
) -> Tensor:
    """Sum what each slot sees [N, S, D]."""
    targets, slots, width = normal_NSD.shape
    query = block.query(normal_NSD).view(targets * slots, block.heads, -1)
    kind = query.dtype
    by_both = torch.bmm(query.transpose(0, 1), folded.query.to(kind))
    by_both = by_both.transpose(0, 1).reshape(targets, slots * block.heads, -1)
    if seen.turn is not None:
        asked, beside = by_both.tensor_split((width,), dim=-1)
        by_both = torch.cat([turned(asked, seen.turn[:, None]), beside], dim=-1)
    score, blind = _cover(seen, slots * block.heads, block.heads)
    share = round(block.dropout * 256) / 256 if block.training else 0.0
    relation: Shared = seen.relation
    looked = _FusedPairs.apply(  # type: ignore[no-untyped-call]
        *(by_both, seen.features.to(kind), seen.index),
        *(relation.of_kind(kind), relation.ticket, relation.pulled),
        *(score, blind, share),
    )
    if seen.turn is not None:
        saw, beside = looked.tensor_split((width,), dim=-1)
        looked = torch.cat([turned_back(saw, seen.turn[:, None]), beside], dim=-1)
    looked = looked.view(targets * slots, block.heads, -1).transpose(0, 1)
    value = torch.bmm(looked, folded.value.to(kind))
    return value.transpose(0, 1).reshape(targets, slots, width)


def _cover(seen: AttentionSources, queries: int, heads: int) -> tuple[Tensor, Tensor]:
    """What is added to scores, and which queries see nobody; made once for all blocks."""
    covers = seen.relation.covers
    if covers is None or covers[0] is not seen.present:
        hidden = ~seen.present
        if hidden.dim() == 3 and hidden.shape[1] > 1:
            hidden = hidden.repeat_interleave(
                heads, dim=1, output_size=queries
            )  # [N, S H, K]
        elif hidden.dim() == 2:
            hidden = hidden[:, None]
        score = torch.zeros(hidden.shape, device=hidden.device)
        score = score.masked_fill_(hidden, HIDDEN_SCORE)
        covers = seen.present, score, hidden.all(dim=-1, keepdim=True)
        object.__setattr__(seen.relation, "covers", covers)
    return covers[1], covers[2]


class _FusedPairs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        by_both: Tensor,
        features: Tensor,
        index: Tensor,
        relation: Tensor,
        ticket: Tensor,
        pulled: Any,
        cover: Tensor,
        blind: Tensor,
        share: float,
    ) -> Tensor:
        width, both = features.shape[1], by_both.shape[2]
        with torch.autocast(by_both.device.type, enabled=False):
            near = _near(features, index)
            score = _products(by_both, near, relation, cover)
            weight = score.softmax(dim=-1).masked_fill_(blind, 0.0)
            used, kept = weight, None
            if share:
                used, kept = torch.native_dropout(weight, share, True)
            used = used.to(features.dtype)
            looked = by_both.new_zeros((*by_both.shape[:2], both + ALIGNED))
            torch.bmm(used, near, out=looked[..., :width])
            torch.bmm(used, relation, out=looked[..., width:both])
            torch.sum(used, dim=-1, out=looked[..., both])
        ctx.save_for_backward(by_both, features, index, relation, weight, kept, ticket)
        ctx.pulled, ctx.share = pulled, share
        return looked

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        by_both, features, index, relation, weight, kept, ticket = ctx.saved_tensors
        width, both = features.shape[1], by_both.shape[2]
        with torch.autocast(by_both.device.type, enabled=False):
            near = _near(features, index)
            to_weight = _products(pull[..., :both], near, relation, pull[..., both, None])
            used = weight
            if kept is not None:
                scale = 1 / (1 - ctx.share)
                to_weight = torch.ops.aten.native_dropout_backward(to_weight, kept, scale)
                used = torch.ops.aten.native_dropout_backward(weight, kept, scale)
            to_score = torch.ops.aten._softmax_backward_data(
                to_weight, weight, -1, weight.dtype
            )
            pair = torch.cat([to_score, used], dim=1).to(features.dtype)  # [N, 2 Q, K]
            to_both = torch.empty_like(by_both)
            to_score = pair[:, : weight.shape[1]]
            torch.bmm(to_score, near, out=to_both[..., :width])
            torch.bmm(to_score, relation, out=to_both[..., width:])
            queries = torch.cat([by_both, pull[..., :both]], dim=1)
            to_near = torch.bmm(pair.mT, queries[..., :width])
            to_features = torch.ops.aten.embedding_dense_backward(
                to_near.flatten(0, 1), index.flatten(), len(features), -1, False
            )
            shared = ctx.needs_input_grad[4]
            if shared:
                _add_products(ctx.pulled, pair.mT, queries[..., width:])
        return (
            to_both, to_features, None,
            None, ticket if shared else None, None, None, None, None,
        )  # fmt: skip


def _near(features: Tensor, index: Tensor) -> Tensor:
    """Features of all neighbours [N, K, D]."""
    return features.index_select(0, index.flatten()).view(*index.shape, -1)


def _products(by_both: Tensor, near: Tensor, relation: Tensor, more: Tensor) -> Tensor:
    """Products of queries with features and relations, and more: float32 [N, Q, K]."""
    width = near.shape[2]
    one, other = by_both[..., :width], by_both[..., width:]
    if near.dtype.itemsize >= FULL_BYTES:
        wide = more.expand(*one.shape[:2], near.shape[1])
        return torch.baddbmm(wide, one, near.mT).baddbmm_(other, relation.mT)
    return (torch.bmm(one, near.mT) + more.float()).add_(torch.bmm(other, relation.mT))


def _add_products(pulled: Any, pair: Tensor, queries: Tensor) -> None:
    """Add products [N, K, R] to a sum in float32."""
    full = pair.dtype.itemsize >= FULL_BYTES
    if pulled.tensor is None:
        found = torch.bmm(pair, queries)
        pulled.tensor = found if full else found.float()
    elif full:
        pulled.tensor.baddbmm_(pair, queries)
    else:
        pulled.tensor.add_(torch.bmm(pair, queries))
