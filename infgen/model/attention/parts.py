"""Products of attention, for a few targets at a time.

Shape letters as in ``neighbour_attention``; L is the number of neighbours that are listed
for a whole group of targets.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

CACHED_NUMBERS = 1 << 19
"""Numbers about targets that are held at once on a CPU: some of its cache."""
VECTOR_NUMBERS = 16
"""Softmax over fewer numbers than a vector register holds is made of plain operations."""


class Sources(NamedTuple):
    """What targets see.

    Attributes:
        features: Of all sources [M, D].
        rows: Row of each neighbour among them [N, K].
        relation: Of the neighbours [N, K, R].
        groups: Ranges of targets that see the same sources, if they do: the targets
            themselves, in their order, and those behind them, up to K of them. Sources are
            the targets then.
    """

    features: Tensor
    rows: Tensor
    relation: Tensor
    groups: tuple[slice, ...] | None

    def parts(self, queries: int) -> Iterator[tuple[slice, Tensor]]:
        """Take targets a few at a time; yield which, and features of their neighbours.

        Those are of each target [N, K, D], or of all targets of a group [L, D].
        """
        if self.groups is None:
            yield from _listed(self.features, self.rows, queries)
            return
        padded = functional.pad(self.features, (0, 0, 0, self.rows.shape[1]))
        for group in self.groups:
            yield group, padded[group.start : group.start + self.rows.shape[1]]


class ToFeatures:
    """The gradient of features, as it is summed up."""

    def __init__(self, sources: Sources) -> None:
        features, index, _, groups = sources
        more = 0 if groups is None else index.shape[1]
        self._sources = sources
        self._sum = features.new_zeros((len(features) + more, features.shape[1]))

    def add(self, part: slice, both: Tensor, wide: Tensor) -> None:
        """Add products of [N, 2 Q, K] and [N, 2 Q, D] about some targets."""
        if self._sources.groups is None:
            _add_rows(self._sum, self._sources.rows[part], torch.bmm(both.mT, wide))
            return
        rows = self._sum[part.start : part.start + both.shape[2]]
        rows += both.flatten(0, 1).T @ wide.reshape(-1, wide.shape[2])

    def total(self) -> Tensor:
        """Return the sum [M, D]."""
        return self._sum[: len(self._sources.features)]


def _listed(
    features: Tensor, index: Tensor, queries: int
) -> Iterator[tuple[slice, Tensor]]:
    targets, neighbours = index.shape
    few = max(1, targets)
    if features.device.type == "cpu":
        few = max(1, CACHED_NUMBERS // ((neighbours + 2 * queries) * features.shape[1]))
    few = min(few, max(1, targets))
    # One buffer for all of them: a fresh one each time costs more than to fill it.
    buffer = features.new_empty((few, neighbours, features.shape[1]))
    for start in range(0, targets, few):
        part = slice(start, min(start + few, targets))
        near = buffer[: part.stop - part.start]
        rows = near.flatten(0, 1)
        torch.index_select(features, 0, index[part].flatten(), out=rows)
        yield part, near


def products(wide_NQE: Tensor, near: Tensor, relation_NKR: Tensor) -> Tensor:
    """Products [N, Q, K] with features and relations together, in float32."""
    width = near.shape[-1]
    of_features = wide_NQE[..., :width]
    if near.dim() == 3:
        found = torch.bmm(of_features, near.mT)
    else:
        found = of_features.reshape(-1, width) @ near.T
        found = found.view(*wide_NQE.shape[:2], len(near))
    if found.dtype == torch.float32:
        return found.baddbmm_(wide_NQE[..., width:], relation_NKR.mT)
    return found.float() + torch.bmm(wide_NQE[..., width:], relation_NKR.mT)


def sums(weight_NQK: Tensor, near: Tensor, out_NQD: Tensor) -> None:
    """Write sums of features, weighted, to where they belong."""
    if near.dim() == 3:
        torch.bmm(weight_NQK, near, out=out_NQD)
    else:
        flat = weight_NQK.reshape(-1, weight_NQK.shape[2])
        torch.mm(flat, near, out=out_NQD.flatten(0, 1))


def widen(narrow: Tensor, weight_HCE: Tensor) -> Tensor:
    """Bring what each head has [B, N, S, H, C] to the space of features: [N, B Q, E]."""
    count, targets, slots, heads, _ = narrow.shape
    rows = narrow.flatten(1, 2).transpose(1, 2).flatten(0, 1)  # [B H, T, C]
    width = weight_HCE.shape[2]
    wide = torch.bmm(rows, weight_HCE).view(count, heads, targets, slots, width)
    # With a single slot a view: every head's rows stay where they are.
    return wide.permute(2, 0, 3, 1, 4).reshape(targets, count * slots * heads, width)


def by_head(wide: Tensor, query: Tensor) -> Tensor:
    """View what queries [N, S, H, C] saw [N, Q, D] head by head: [H, T, D]."""
    targets, slots, heads, _ = query.shape
    return wide.view(targets * slots, heads, wide.shape[-1]).transpose(0, 1)


def by_slot(score: Tensor, cover: Tensor) -> Tensor:
    """View numbers of queries [N, Q, K] slot by slot: [N, S, H, K]."""
    targets, slots, neighbours = cover.shape
    return score.view(targets, slots, score.shape[1] // slots, neighbours)


def softmax(score: Tensor) -> Tensor:
    """Softmax over neighbours, in place where that is quicker."""
    if score.device.type != "cpu" or not 0 < score.shape[-1] < VECTOR_NUMBERS:
        return score.softmax(dim=-1)
    # Torch takes so few numbers one by one, five times as long as this.
    score.sub_(score.amax(dim=-1, keepdim=True)).exp_()
    return score.div_(score.sum(dim=-1, keepdim=True))


def _add_rows(rows: Tensor, index: Tensor, values: Tensor) -> None:
    """Add values [N, K, D] to the rows [M, D] that an index [N, K] names."""
    index, values = index.flatten(), values.flatten(0, 1)
    if rows.device.type == "cpu":
        rows.index_add_(0, index, values)
    else:  # There ``index_add_`` adds in any order.
        rows += torch.ops.aten.embedding_dense_backward(values, index, len(rows), -1, False)


def add_product(total: Tensor, one: Tensor, other: Tensor, *, first: bool) -> None:
    """Add products to a float32 total; the first ones are written over what it holds."""
    if one.dtype != total.dtype:
        product = torch.bmm(one, other)
        total.copy_(product) if first else total.add_(product)
    elif first:
        torch.bmm(one, other, out=total)
    else:
        total.baddbmm_(one, other)
