"""Attention over padded neighbour lists, with its gradient written out.

What is big here is what there is per pair: the neighbours' features, gathered from the
rows of all sources, and their relations to the target, which many layers share. Left to
autograd both would be kept, or made anew, for every layer. Instead targets are taken a few
at a time, so that their pairs stay in the processor's cache: features are gathered when
they are used, again in the backward pass, and the gradient of shared relations is summed
in place.

Shape letters as in ``layers``, Q queries of a target (its slots times its heads), and M
rows of sources.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

HIDDEN_SCORE = -1e9
"""Score of what a target does not see: its weight is exactly zero beside any other."""
CACHED_NUMBERS = 1 << 18
"""Numbers of one kind per pair that are held at once on a CPU: some of its cache."""


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
    covers: tuple[Tensor, Tensor, Tensor] | None = None

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
    """A sum that grows in place; empty until something is added."""

    tensor: Tensor | None = field(default=None)


class _Ticket(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, pulled: _Sum) -> Tensor:
        ctx.pulled = pulled
        return tensor.new_zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, None]:
        summed, ctx.pulled.tensor = ctx.pulled.tensor, None
        return summed, None


class AttentionResult(NamedTuple):
    """What queries saw.

    Attributes:
        features: Neighbours' features summed by weight [N, Q, D].
        relation: Their relations summed by weight [N, Q, R].
        weight: Sum of the weights [N, Q]: 1, but for dropout, or 0 without neighbours.
    """

    features: Tensor
    relation: Tensor
    weight: Tensor


def attend_to_pairs(
    by_features: Tensor,
    by_relation: Tensor,
    features: Tensor,
    index: Tensor,
    relation: Shared,
    hidden: Tensor,
    kept: Tensor | None,
) -> AttentionResult:
    """Weigh neighbours by the softmax of their scores, and sum them.

    Args:
        by_features: Queries for features [N, Q, D]; the score is the sum of both products.
        by_relation: Queries for relations [N, Q, R].
        features: Of all sources [M, D].
        index: Row of each neighbour among them [N, K].
        relation: Of the neighbours [N, K, R].
        hidden: Which neighbours there are not [N, Q, K], or [N, 1, K] for all queries.
        kept: Factor on each weight for dropout [N, Q, K], or None.
    """
    kind = by_features.dtype  # The queries' own: low precision under autocast.
    shared = relation.of_kind(kind), relation.ticket, relation.pulled
    kept = None if kept is None else kept.to(kind)
    # Batches of products are slow where the queries lie head by head, as they may come.
    queries = by_features.contiguous(), by_relation.contiguous()
    pairs = (*queries, features.to(kind), index, *shared, hidden, kept)
    with torch.autocast(by_features.device.type, enabled=False):
        return AttentionResult(*_Pairs.apply(*pairs))  # type: ignore[no-untyped-call]


@dataclass(frozen=True, slots=True)
class _Cover:
    """What hides neighbours from queries: added to scores, and what is left of weights."""

    score: Tensor
    blind: Tensor | None

    @classmethod
    def of(cls, hidden: Tensor, like: Tensor) -> "_Cover":
        score = like.new_zeros(hidden.shape).masked_fill_(hidden, HIDDEN_SCORE)
        blind = hidden.all(dim=-1, keepdim=True)
        # Looking whether anybody is blind saves a pass, but would make a GPU wait.
        needed = blind.device.type != "cpu" or bool(blind.any())
        return cls(score, blind if needed else None)

    def weigh(self, score: Tensor, part: slice) -> Tensor:
        """Turn scores into weights; a query without neighbours has none."""
        weight = score.softmax(dim=-1)
        return weight if self.blind is None else weight.masked_fill_(self.blind[part], 0.0)


class _Pairs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        by_features: Tensor,
        by_relation: Tensor,
        features: Tensor,
        index: Tensor,
        relation: Tensor,
        ticket: Tensor,
        pulled: _Sum,
        hidden: Tensor,
        kept: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        shape = (*by_features.shape[:2], index.shape[1])
        learns = any(ctx.needs_input_grad)
        weight = by_features.new_empty(shape if learns else (0, *shape[1:]))
        total = by_features.new_empty(shape[:2])
        saw, related = torch.empty_like(by_features), torch.empty_like(by_relation)
        cover = _Cover.of(hidden, by_features)
        for part, near in _parts(features, index):
            score = torch.baddbmm(
                cover.score[part], by_features[part], near.transpose(1, 2)
            )
            score.baddbmm_(by_relation[part], relation[part].transpose(1, 2))
            used = cover.weigh(score, part)
            if learns:
                weight[part] = used
            used = used if kept is None else used.mul_(kept[part])
            torch.bmm(used, near, out=saw[part])
            torch.bmm(used, relation[part], out=related[part])
            torch.sum(used, dim=-1, out=total[part])
        ctx.save_for_backward(
            by_features, by_relation, features, index, relation, weight, kept
        )
        ctx.pulled = pulled
        return saw, related, total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor) -> tuple[Tensor | None, ...]:
        by_features, by_relation, features, index, relation, weight, kept = (
            ctx.saved_tensors
        )
        pull_features, pull_relation, pull_total = (pull.contiguous() for pull in pulls)
        shared = ctx.needs_input_grad[5]
        to_queries, to_relation_queries = (
            torch.empty_like(by_features),
            torch.empty_like(by_relation),
        )
        to_features = torch.zeros_like(features)
        first = ctx.pulled.tensor is None
        if shared and first:
            ctx.pulled.tensor = torch.empty_like(relation)
        for part, near in _parts(features, index):
            pull = torch.bmm(pull_features[part], near.transpose(1, 2))
            pull.baddbmm_(pull_relation[part], relation[part].transpose(1, 2))
            pull.add_(pull_total[part, :, None])
            used = weight[part]
            if kept is not None:
                pull.mul_(kept[part])
            pull.sub_((pull * used).sum(dim=-1, keepdim=True)).mul_(used)  # The score's.
            used = used if kept is None else used * kept[part]
            torch.bmm(pull, near, out=to_queries[part])
            torch.bmm(pull, relation[part], out=to_relation_queries[part])

            both = torch.cat([pull, used], dim=1).transpose(1, 2)  # [N, K, 2 Q]
            to_near = torch.bmm(both, _beside(by_features, pull_features, part))
            to_features += torch.ops.aten.embedding_dense_backward(
                to_near.flatten(0, 1), index[part].flatten(), len(features), -1, False
            )
            if not shared:
                continue
            queries = _beside(by_relation, pull_relation, part)
            if first:
                torch.bmm(both, queries, out=ctx.pulled.tensor[part])
            else:
                ctx.pulled.tensor[part].baddbmm_(both, queries)
        ticket = relation.new_zeros(()) if shared else None
        return (
            to_queries, to_relation_queries, to_features,
            None, None, ticket, None, None, None,
        )  # fmt: skip


def _beside(one: Tensor, other: Tensor, part: slice) -> Tensor:
    return torch.cat([one[part], other[part]], dim=1)


def _parts(features: Tensor, index: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Take targets a few at a time; yield which, and their neighbours' features."""
    targets, neighbours = index.shape
    few = max(1, targets)
    if features.device.type == "cpu":
        few = max(1, CACHED_NUMBERS // max(1, neighbours * features.shape[1]))
    for start in range(0, targets, few):
        part = slice(start, min(start + few, targets))
        near = features.index_select(0, index[part].flatten())
        yield part, near.view(part.stop - part.start, neighbours, features.shape[1])
