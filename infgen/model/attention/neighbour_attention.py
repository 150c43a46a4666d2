"""Attention over padded neighbour lists, with its gradient written out.

What is big here is what there is per pair: the neighbours' features, gathered from the
rows of all sources, and their relations to the target, which many layers share. Left to
autograd both would be kept, or made anew, for every layer. Instead queries are brought to
the space of features, and sums back from it; targets are taken a few at a time, so that
everything about their neighbours stays in the processor's cache; features are gathered
again in the backward pass, and the gradient of shared relations is summed in place.

Shape letters as in ``layers``: N targets, S slots, H heads, C width of a head, K
neighbours, D width of features, R of relations, E of both, M rows of sources; T are the
slots of all targets, and Q the queries of a target, its slots times its heads.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from infgen.model.attention.parts import (
    Sources,
    ToFeatures,
    add_product,
    by_head,
    by_slot,
    products,
    softmax,
    sums,
    widen,
)
from infgen.model.rotary.turns import turned_back, turned_first

HIDDEN_SCORE = -1e9
"""Score of what a target does not see: its weight is exactly zero beside any other."""


@dataclass(frozen=True, eq=False, slots=True)
class Shared:
    """A tensor that many layers read, and the one sum of their gradients.

    Attributes:
        values: The tensor, without a gradient of its own [N, K, R].
        ticket: Stands for it in the graph: it depends on every layer that reads the values
            through it, so their gradients are complete when its own arrives.
        pulled: Where layers add their gradients to.
        copies: The values in other precisions, made on first use.
        covers: Who is present, and what hides the others: of ``device.attention``.
    """

    values: Tensor
    ticket: Tensor
    pulled: "_Sum"
    copies: dict[torch.dtype, Tensor] = field(default_factory=dict)
    covers: tuple[Tensor, Any] | None = None

    @classmethod
    def of(cls, tensor: Tensor) -> "Shared":
        """Share a tensor; its gradient is that of all its readers."""
        pulled = _Sum()
        ticket = _Ticket.apply(tensor, pulled)  # type: ignore[no-untyped-call]
        return cls(tensor.detach(), ticket, pulled)

    def of_kind(self, kind: torch.dtype) -> Tensor:
        """Return the values in some precision: one copy for all layers."""
        if kind == self.values.dtype:
            return self.values
        if kind not in self.copies:
            self.copies[kind] = self.values.to(kind)
        return self.copies[kind]


@dataclass(slots=True)
class _Sum:
    """A float32 sum that grows in place; empty until something is added."""

    tensor: Tensor | None = field(default=None)


class _Ticket(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, pulled: _Sum) -> Tensor:
        ctx.pulled = pulled
        ctx.set_materialize_grads(False)  # That readers give none: it is in the sum.
        return tensor.new_zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor | None) -> tuple[Tensor | None, None]:
        summed, ctx.pulled.tensor = ctx.pulled.tensor, None
        return summed, None


class PairWeights(NamedTuple):
    """Weights of keys and values, the gains and biases of norms folded in.

    Attributes:
        key: Of features, and behind them of relations [H, C, E].
        value: Of the same [H, C, E].
        value_bias: Added to every value [H, C]; in keys a bias would cancel out.
    """

    key: Tensor
    value: Tensor
    value_bias: Tensor


class Hiding(NamedTuple):
    """What targets do not see.

    Attributes:
        cover: Added to scores: ``HIDDEN_SCORE`` for what a slot does not see [N, S, K].
        blind: Slots that see no neighbour [N, S, 1]; None if there are surely none.
    """

    cover: Tensor
    blind: Tensor | None

    @classmethod
    def of(cls, present: Tensor) -> "Hiding":
        """Hide all that is not present [N, S, K]."""
        hidden = ~present
        blind = hidden.all(dim=-1, keepdim=True)
        # Looking whether there are any saves a pass, but would make a GPU wait.
        some = blind.device.type != "cpu" or bool(blind.any())
        return cls(hidden * HIDDEN_SCORE, blind if some else None)


def attend_to_pairs(
    query: Tensor,
    weights: PairWeights,
    features: Tensor,
    index: Tensor,
    relation: Shared,
    hiding: Hiding,
    kept: Tensor | None,
    turn: Tensor | None = None,
    groups: tuple[slice, ...] | None = None,
) -> Tensor:
    """Weigh the values of neighbours by the softmax of their scores, and sum them.

    Args:
        query: Scaled queries [N, S, H, C].
        weights: Of keys and values.
        features: Of all sources [M, D].
        index: Row of each neighbour among them [N, K].
        relation: Of the neighbours [N, K, R].
        hiding: Which neighbours a slot does not see.
        kept: Factor on each weight for dropout [N, S, H, K], or None.
        turn: By what features are turned at the targets [N, P], if those of the sources are
            turned: queries are turned as the sources are, and sums turned back.
        groups: Ranges of targets that see the same sources, as in ``Sources``.

    Returns:
        Sums [N, S, H, C]; zero for a slot that sees no neighbour.
    """
    kind = query.dtype  # The queries' own: low precision under autocast.
    weights = PairWeights(*(weight.to(kind) for weight in weights))
    kept = None if kept is None else kept.to(kind).flatten(1, 2)
    sources = Sources(features.to(kind), index, relation.of_kind(kind), groups)
    query = query.contiguous()
    with _no_autocast(query.device.type):
        if not torch.is_grad_enabled():
            return _look(query, weights, sources, hiding, kept, turn, None)[0]
        shared = relation.ticket, relation.pulled
        summed: Tensor = _Attend.apply(  # type: ignore[no-untyped-call]
            query, *weights, *sources, *shared, hiding, kept, turn
        )
    return summed


def _no_autocast(device: str) -> AbstractContextManager[object]:
    """Leave precisions as they are; to enter autocast, even to end it, takes a while."""
    if torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return nullcontext()


def _look(
    query: Tensor,
    weights: PairWeights,
    sources: Sources,
    hiding: Hiding,
    kept: Tensor | None,
    turn: Tensor | None,
    weight: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Attend; what differs by neighbour is made a few targets at a time.

    Args:
        query: Scaled queries [N, S, H, C].
        weights: Of keys and values.
        sources: What is seen.
        hiding: What of it is not seen.
        kept: Factor on each weight for dropout [N, Q, K], or None.
        turn: As in ``attend_to_pairs``.
        weight: Where the weights of pairs are written to [N, Q, K], if they are wanted.

    Returns:
        Sums of values [N, S, H, C], of features [N, Q, D], and of relations [N, Q, R], and
        of weights [N, Q], or None if these are 1.
    """
    (features, index, relation, _), (cover, blind) = sources, hiding
    queries, width = query.shape[1] * query.shape[2], features.shape[1]
    asked = turned_first(widen(query[None], weights.key), turn)
    saw = query.new_empty((len(index), queries, width))
    related = query.new_empty((len(index), queries, relation.shape[2]))
    total = None
    if kept is not None or blind is not None:
        total = query.new_empty((len(index), queries))
    for part, near in sources.parts(queries):
        score = products(asked[part], near, relation[part])
        by_slot(score, cover[part]).add_(cover[part, :, None])
        used = softmax(score).to(query.dtype)
        if blind is not None:
            by_slot(used, cover[part]).masked_fill_(blind[part, :, None], 0.0)
        if weight is not None:
            weight[part] = used
        if kept is not None:
            used = used * kept[part]
        sums(used, near, saw[part])
        torch.bmm(used, relation[part], out=related[part])
        if total is not None:
            torch.sum(used, dim=-1, out=total[part])
    saw = turned_back(saw, None if turn is None else turn[:, None])
    value = weights.value.mT
    found = torch.bmm(by_head(saw, query), value[:, :width])
    found = found.baddbmm_(by_head(related, query), value[:, width:])
    found = found.transpose(0, 1).view_as(query)
    if total is None:
        summed = found + weights.value_bias
    else:
        own = total.view(*query.shape[:3], 1)
        summed = torch.addcmul(found, own, weights.value_bias)
    return summed, saw, related, total


class _Attend(torch.autograd.Function):
    """The same with its gradient; wide queries are made again in the backward pass."""

    @staticmethod
    def forward(
        ctx: Any,
        query: Tensor,
        key: Tensor,
        value: Tensor,
        value_bias: Tensor,
        features: Tensor,
        index: Tensor,
        relation: Tensor,
        groups: tuple[slice, ...] | None,
        ticket: Tensor,
        pulled: _Sum,
        hiding: Hiding,
        kept: Tensor | None,
        turn: Tensor | None,
    ) -> Tensor:
        queries = query.shape[1] * query.shape[2]
        weight = query.new_empty((len(index), queries, index.shape[1]))
        weights = PairWeights(key, value, value_bias)
        sources = Sources(features, index, relation, groups)
        summed, *seen = _look(query, weights, sources, hiding, kept, turn, weight)
        ctx.save_for_backward(query, *weights, *sources[:3], weight, *seen, kept, turn)
        ctx.pulled, ctx.groups = pulled, groups
        return summed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        (
            query, key, value, value_bias,
            features, index, relation, weight, saw, related, total, kept, turn,
        ) = ctx.saved_tensors  # fmt: skip
        queries, width = weight.shape[1], features.shape[1]
        sources = Sources(features, index, relation, ctx.groups)
        shared = ctx.needs_input_grad[8]
        first = ctx.pulled.tensor is None
        if shared and first:
            ctx.pulled.tensor = torch.empty_like(relation, dtype=torch.float32)
        pair = widen(torch.stack([query, pull]), torch.cat([key, value]))
        pair = turned_first(pair, turn)
        to_total = (pull * value_bias).sum(dim=-1).flatten(1)
        to_saw, to_related = torch.empty_like(saw), torch.empty_like(related)
        to_features = ToFeatures(sources)
        for part, near in sources.parts(queries):
            used, beside = weight[part], relation[part]
            both = used.new_empty((len(used), 2 * queries, used.shape[2]))
            to_score, dropped = both.split(queries, dim=1)
            to_used = products(pair[part, queries:], near, beside)
            to_used.add_(to_total[part, :, None])
            if kept is None:
                dropped.copy_(used)
            else:
                torch.mul(used, kept[part], out=dropped)
                to_used.mul_(kept[part])
            to_used.sub_((to_used * used).sum(dim=-1, keepdim=True))
            torch.mul(to_used, used, out=to_score)
            sums(to_score, near, to_saw[part])
            torch.bmm(to_score, beside, out=to_related[part])
            to_features.add(part, both, pair[part, :, :width])
            if shared:
                more = both.mT, pair[part, :, width:]
                add_product(ctx.pulled.tensor[part], *more, first=first)
        to_saw = turned_back(to_saw, None if turn is None else turn[:, None])
        to_asked = by_head(to_saw, query), by_head(to_related, query)
        seen = by_head(saw, query), by_head(related, query)
        pulled = torch.bmm(to_asked[0], key[..., :width].mT)
        pulled.baddbmm_(to_asked[1], key[..., width:].mT)
        asked, given = (each.flatten(0, 1).permute(1, 2, 0) for each in (query, pull))
        own = pull if total is None else pull * total.view(*pull.shape[:3], 1)
        return (
            pulled.transpose(0, 1).reshape(query.shape),
            torch.cat([torch.bmm(asked, each) for each in to_asked], dim=2),
            torch.cat([torch.bmm(given, each) for each in seen], dim=2),
            own.sum(dim=(0, 1)), to_features.total(),
            None, None, None, None, None, None, None, None,
        )  # fmt: skip
