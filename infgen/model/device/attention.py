"""One attention block with fewer launches, for training on a GPU.

``layers.Attention`` is written for a CPU, where a launch costs nothing and its cache is
small. A GPU has the whole of a batch at once: weights are folded for all blocks together,
queries for features and relations come from one product, and so do values, and dropout is
drawn where weights are. Gradients are written out, so that sums of them are made within
products. Values are those of ``layers.Attention`` but for rounding.

Under autocast scores and weights, and the sum of all layers' gradients of relations, are
float32; only products have half the bits.

Shape letters as in ``neighbour_attention``; E the width of what a query sees: D, R, the sum
of its weights, and as many zeros as keep rows aligned; T the slots of all targets.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from infgen.model.attention.neighbour_attention import HIDDEN_SCORE, Shared
from infgen.model.device.folding import ALIGNED, Folded, fold
from infgen.model.layers import Attention, AttentionSources, normed
from infgen.model.rotary.turns import turned_first

FULL_BYTES = 4
"""Of a float32; numbers of fewer bytes are products only."""


@contextmanager
def folded_together(blocks: Sequence[Attention]) -> Iterator[None]:
    """Let blocks of one shape be evaluated by ``attend``, their weights folded at once."""
    blocks = sorted(blocks, key=lambda block: block.norm_source is not None)
    try:
        for block, folded in zip(blocks, fold(blocks), strict=True):
            block.fused = lambda target, seen, block=block, folded=folded: attend(
                block, folded, target, seen
            )
        yield
    finally:
        for block in blocks:
            block.fused = None


def attend(
    block: Attention, folded: Folded, target: Tensor, seen: AttentionSources
) -> Tensor:
    """Update targets [N, D] or [N, S, D] as the block does.

    A block without a norm for sources is one whose sources are its targets, in one order:
    these are normed already, unless they are turned as well.
    """
    slots = target if target.dim() == 3 else target[:, None]
    alike = block.norm_source is None and seen.turn is None
    normal = seen.features[:, None] if alike else normed(slots)
    looked = _look(block, folded, normal, seen)
    slots = slots + block.norm_out(block.out(looked).view_as(slots))
    norm, *_, norm_out = block.feed_forward
    forward = _FeedForward.apply(  # type: ignore[no-untyped-call]
        norm(slots).flatten(0, 1), *folded[-4:], _dropped(block)
    )
    slots = slots + norm_out(forward.view_as(slots))
    return slots.view_as(target)


def _dropped(block: Attention) -> float:
    """Share that dropout drops, as on a CPU: a multiple of 1/256."""
    return round(block.dropout * 256) / 256 if block.training else 0.0


def _look(
    block: Attention, folded: Folded, normal_NSD: Tensor, seen: AttentionSources
) -> Tensor:
    """Gate what each slot sees and what it is itself [T, D]."""
    slots, kind = normal_NSD.shape[1], folded.query.dtype
    cover, blind = _cover(seen, slots * block.heads, block.heads)
    relation: Shared = seen.relation
    looked: Tensor = _Look.apply(  # type: ignore[no-untyped-call]
        *(normal_NSD.flatten(0, 1).to(kind), *folded[:6]),
        *(seen.features.to(kind), seen.index),
        *(relation.of_kind(kind), relation.ticket, relation.pulled),
        *(cover, blind, _dropped(block), seen.turn),
    )
    return looked


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
        found = hidden * HIDDEN_SCORE, hidden.all(dim=-1, keepdim=True)
        covers = seen.present, found
        object.__setattr__(seen.relation, "covers", covers)
    cover, blind = covers[1]
    return cover, blind


class _Look(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        query: Tensor,
        query_bias: Tensor,
        wide: Tensor,
        value: Tensor,
        gate: Tensor,
        gate_bias: Tensor,
        features: Tensor,
        index: Tensor,
        relation: Tensor,
        ticket: Tensor,
        pulled: Any,
        cover: Tensor,
        blind: Tensor,
        share: float,
        turn: Tensor | None,
    ) -> Tensor:
        heads, both = len(wide), wide.shape[2]
        with torch.autocast(normal.device.type, enabled=False):
            asked = _heads(torch.addmm(query_bias, normal, query.T), heads)
            by_both = normal.new_empty((*asked.shape[:2], both))
            torch.bmm(asked.transpose(0, 1), wide, out=by_both.transpose(0, 1))
            by_both = turned_first(by_both.view(len(index), -1, both), turn)
            weight, kept, looked = _weigh(
                by_both, features, index, relation, (cover, blind), share
            )
            looked = turned_first(looked, turn, back=True)
            each = looked.view(-1, heads, looked.shape[2]).transpose(0, 1)
            saw = torch.bmm(each, value).transpose(0, 1)
            joined = torch.cat([saw, _heads(normal, heads)], dim=1).flatten(1)
            opened, between = torch.addmm(gate_bias, joined, gate.T).chunk(2, dim=1)
            opened = opened.sigmoid()
            found = torch.addcmul(joined.chunk(2, dim=1)[0], opened, between)
        ctx.save_for_backward(
            query, wide, value, gate, features, index, relation,
            asked, by_both, weight, kept, looked, joined, opened, between, turn,
        )  # fmt: skip
        ctx.pulled, ctx.share = pulled, share
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        (
            query, wide, value, gate, features, index, relation,
            asked, by_both, weight, kept, looked, joined, opened, between, turn,
        ) = ctx.saved_tensors  # fmt: skip
        heads, width = len(wide), pull.shape[1]
        with torch.autocast(pull.device.type, enabled=False):
            through = pull.new_empty((len(pull), 2 * width))
            one, other = through.chunk(2, dim=1)
            torch.mul(pull, opened, out=other)
            torch.ops.aten.sigmoid_backward(pull * between, opened, grad_input=one)
            to_saw, to_normal = (through @ gate).chunk(2, dim=1)
            to_each = _heads(to_saw.add_(pull), heads).transpose(0, 1)
            to_looked = torch.empty_like(looked)
            of_heads = (-1, heads, looked.shape[2])
            torch.bmm(to_each, value.mT, out=to_looked.view(of_heads).transpose(0, 1))
            to_value = torch.bmm(looked.view(of_heads).permute(1, 2, 0), to_each)

            shared = ctx.pulled if ctx.needs_input_grad[10] else None
            to_both, to_features = _pull_pairs(
                turned_first(to_looked, turn),
                by_both,
                (features, index, relation),
                (weight, kept),
                ctx.share,
                shared,
            )
            of_heads = (-1, heads, by_both.shape[2])
            to_both = turned_first(to_both, turn, back=True).view(of_heads).transpose(0, 1)
            to_asked = torch.empty_like(asked)
            torch.bmm(to_both, wide.mT, out=to_asked.transpose(0, 1))
            to_wide = torch.bmm(asked.permute(1, 2, 0), to_both)
            to_asked = to_asked.flatten(1)
            normal = joined.chunk(2, dim=1)[1]
            return (
                torch.addmm(to_normal, to_asked, query),
                *(to_asked.T @ normal, to_asked.sum(dim=0), to_wide, to_value),
                *(through.T @ joined, through.sum(dim=0), to_features, None),
                *(None, None, None, None, None, None, None),
            )


def _heads(values_TD: Tensor, heads: int) -> Tensor:
    """View values head by head [T, H, C]."""
    return values_TD.view(len(values_TD), heads, -1)


def _weigh(
    by_both: Tensor,
    features: Tensor,
    index: Tensor,
    relation: Tensor,
    hiding: tuple[Tensor, Tensor],
    share: float,
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Weights of pairs [N, Q, K], which of them dropout keeps, and their sums [N, Q, E]."""
    (cover, blind), width, both = hiding, features.shape[1], by_both.shape[2]
    near = _near(features, index)
    score = _products(by_both, near, relation, cover)
    weight = score.softmax(dim=-1).masked_fill_(blind, 0.0)
    used, kept = weight, None
    if share:
        used, kept = torch.native_dropout(weight, share, True)
    used = used.to(features.dtype)
    looked = by_both.new_empty((*by_both.shape[:2], both + ALIGNED))
    torch.bmm(used, near, out=looked[..., :width])
    torch.bmm(used, relation, out=looked[..., width:both])
    # Columns beyond the first meet zeros in the weights: they need be no more than finite.
    alike = used[:, :, None].expand(-1, -1, ALIGNED, -1)
    torch.sum(alike, dim=-1, out=looked[..., both:])
    return weight, kept, looked


def _pull_pairs(
    pull: Tensor,
    by_both: Tensor,
    sources: tuple[Tensor, Tensor, Tensor],
    weights: tuple[Tensor, Tensor | None],
    share: float,
    pulled: Any,
) -> tuple[Tensor, Tensor]:
    """Gradients of queries and features; those of relations are added to ``pulled``."""
    (features, index, relation), (weight, kept) = sources, weights
    width, both = features.shape[1], by_both.shape[2]
    near = _near(features, index)
    to_weight = _products(pull[..., :both], near, relation, pull[..., both, None])
    used = weight
    if kept is not None:
        scale = 1 / (1 - share)
        to_weight = torch.ops.aten.native_dropout_backward(to_weight, kept, scale)
        used = torch.ops.aten.native_dropout_backward(weight, kept, scale)
    to_score = torch.ops.aten._softmax_backward_data(to_weight, weight, -1, weight.dtype)
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
    if pulled is not None:
        _add_products(pulled, pair.mT, queries[..., width:])
    return to_both, to_features


class _FeedForward(torch.autograd.Function):
    """Two layers with ReLU and dropout between them: only what is left of it is kept."""

    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        hidden: Tensor,
        hidden_bias: Tensor,
        out: Tensor,
        out_bias: Tensor,
        share: float,
    ) -> Tensor:
        kind = hidden.dtype
        with torch.autocast(normal.device.type, enabled=False):
            normal = normal.to(kind)
            left = torch._addmm_activation(hidden_bias, normal, hidden.T)  # With ReLU.
            if share:
                left = torch.native_dropout(left, share, True)[0]
            found = torch.addmm(out_bias, left, out.T)
        ctx.save_for_backward(normal, hidden, out, left)
        ctx.scale = 1 / (1 - share)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        normal, hidden, out, left = ctx.saved_tensors
        with torch.autocast(pull.device.type, enabled=False):
            # A product alone, scaled: beta is zero.
            scaled = torch.addmm(out[:1], pull, out, beta=0, alpha=ctx.scale)
            through = torch.ops.aten.threshold_backward(scaled, left, 0)
            return (
                through @ hidden,
                *(through.T @ normal, through.sum(dim=0)),
                *(pull.T @ left, pull.sum(dim=0), None),
            )


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
