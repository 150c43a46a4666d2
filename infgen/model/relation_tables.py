"""Relations as features, read from tables instead of computed pair by pair.

Shape letters as in ``layers``: N pairs (or targets), K neighbours of a target, D width, F
scalars, P nodes of all tables.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from infgen.model.layers import FourierEmbedding

NORM_EPS = 1e-5
"""What norms add to a variance, as torch's do."""
CACHED_NUMBERS = 1 << 18
"""Numbers of relations that are held at once on a CPU: some of its cache."""
SUM = 0
"""Of bags of embeddings: torch's number of the mode."""


@dataclass(frozen=True, slots=True)
class Span:
    """Range of a scalar that a table covers; values beyond are taken as its ends.

    Attributes:
        first: Where the first node is.
        last: Where the last node is.
        nodes: Number of nodes, evenly spaced.
        closed: Whether the two ends mean the same, as for angles of -pi and pi: rounding
            must not tell them apart.
    """

    first: float
    last: float
    nodes: int
    closed: bool = False


class RelationEmbedding(FourierEmbedding):
    """A Fourier embedding of relations, read from tables instead of computed per pair.

    Every scalar's function is evaluated at evenly spaced nodes and is linear between them:
    a few thousand evaluations instead of one per pair of neighbours. Training and
    simulation use the same tables, so there is no difference between the two.
    """

    first: Tensor
    gaps: Tensor
    zero: Tensor
    last_gap: Tensor
    per_unit: Tensor
    starts: Tensor

    def __init__(self, spans: Sequence[Span], bands: int, width: int) -> None:
        super().__init__(len(spans), bands, width)
        self.spans = tuple(spans)
        gaps = torch.tensor([float(span.nodes - 1) for span in spans])
        length = torch.tensor([span.last - span.first for span in spans])
        starts = torch.tensor([0, *(span.nodes for span in spans[:-1])]).cumsum(0)
        for name, values in (
            ("first", torch.tensor([span.first for span in spans])),
            ("gaps", gaps),
            ("zero", torch.zeros_like(gaps)),
            ("last_gap", gaps - 1),
            ("per_unit", gaps / length),
            ("starts", starts),
        ):
            self.register_buffer(name, values, persistent=False)
        self.evaluated: Tensor | None = None

    def table(self) -> Tensor:
        """Evaluate all scalars at their nodes: [P, D], one scalar after the other.

        In float32 also under autocast, as ``look_up``: geometry needs its digits.
        """
        if self.evaluated is not None:  # By ``device.tables``, for all embeddings at once.
            return self.evaluated
        with torch.autocast(self.frequency.weight.device.type, enabled=False):
            return torch.cat([self._nodes(i, span) for i, span in enumerate(self.spans)])

    def turn(self, pose: Tensor, token: Tensor | float = 0.0) -> None:
        """Return by what features are turned: by nothing, unlike ``RotaryRelation``."""

    def _nodes(self, number: int, span: Span) -> Tensor:
        device = self.frequency.weight.device
        at = torch.linspace(span.first, span.last, span.nodes, device=device)
        values = self.scalar(number, at)
        if not span.closed:
            return values
        middle = (values[:1] + values[-1:]) / 2
        return torch.cat([middle, values[1:-1], middle])

    def look_up(self, values: Tensor, table_PD: Tensor) -> Tensor:
        """Embed relations [N, K, F] by a table: normed features [N, K, D]."""
        norm, _, linear = self.out
        weights = (table_PD, norm.weight, norm.bias, linear.weight, linear.bias)
        with torch.autocast(values.device.type, enabled=False):
            places = self._places(values.flatten(0, -2))
            found = _LookUp.apply(*places, *weights)  # type: ignore[no-untyped-call]
        embedded: Tensor = found.view(*values.shape[:-1], table_PD.shape[1])
        return embedded

    def _places(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Say between which nodes relations [N, F] lie: nodes and their shares [N, 2 F]."""
        position = ((values - self.first) * self.per_unit).clamp(self.zero, self.gaps)
        lower = position.floor().minimum(self.last_gap)
        share = position - lower
        node = lower.long() + self.starts
        return torch.cat([node, node + 1], dim=-1), torch.cat([1 - share, share], dim=-1)


class _LookUp(torch.autograd.Function):
    """Weighted rows of a table, then norm, ReLU, linear layer and norm: [N, D].

    On a CPU some relations at a time, so that what lies between the two stays in its cache;
    in the backward pass it is made again up to the linear layer. Only the result is kept.
    """

    @staticmethod
    def forward(
        ctx: Any,
        nodes: Tensor,
        shares: Tensor,
        table_PD: Tensor,
        gain: Tensor,
        shift: Tensor,
        weight: Tensor,
        bias: Tensor,
    ) -> Tensor:
        learned, parts = (table_PD, gain, shift, weight, bias), _parts(nodes, table_PD)
        if len(parts) == 1:
            found, scale = _features(nodes, shares, *learned)
        else:
            found = table_PD.new_empty((len(nodes), len(weight)))
            scale = table_PD.new_empty((len(nodes), 1))
            for part in parts:
                some = _features(nodes[part], shares[part], *learned)
                found[part], scale[part] = some
        ctx.save_for_backward(nodes, shares, table_PD, gain, shift, weight, found, scale)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        nodes, shares, table_PD, gain, shift, weight, found, scale = ctx.saved_tensors
        learned = table_PD, gain, shift, weight

        if nodes.device.type != "cpu":  # All at once.
            to_raw = _through_norm_at_once(pull, found, scale)
            back = _through_rows(to_raw, nodes, shares, *learned)
            hidden, to_summed, gains, shifts = back
            table = _back_in_segments(to_summed, nodes, shares, len(table_PD))
            return None, None, table, gains, shifts, to_raw.T @ hidden, to_raw.sum(dim=0)
        table, gains, shifts, weights, biases = (
            torch.zeros_like(like) for like in (*learned, shift)
        )
        for part in _parts(nodes, table_PD):
            to_raw = _through_norm(pull[part], found[part]).mul_(scale[part])
            back = _through_rows(to_raw, nodes[part], shares[part], *learned)
            hidden, to_summed, to_gain, to_shift = back
            weights.addmm_(to_raw.T, hidden)
            biases += to_raw.sum(dim=0)
            gains += to_gain
            shifts += to_shift
            table += _back_to_rows(to_summed, nodes[part], shares[part], len(table))
        return None, None, table, gains, shifts, weights, biases


def _features(
    nodes: Tensor,
    shares: Tensor,
    table_PD: Tensor,
    gain: Tensor,
    shift: Tensor,
    weight: Tensor,
    bias: Tensor,
) -> tuple[Tensor, Tensor]:
    """Normed features [N, R] of relations, and what they were scaled by [N, 1]."""
    summed = _weighted_rows(table_PD, nodes, shares)
    hidden = functional.layer_norm(summed, gain.shape, gain, shift).relu_()
    raw = functional.linear(hidden, weight, bias)
    found, _, scale = torch.native_layer_norm(raw, gain.shape, None, None, NORM_EPS)
    return found, scale


def _through_rows(
    to_raw: Tensor,
    nodes: Tensor,
    shares: Tensor,
    table_PD: Tensor,
    gain: Tensor,
    shift: Tensor,
    weight: Tensor,
) -> tuple[Tensor, ...]:
    """Pull a gradient back to before the first norm; what was hidden comes first."""
    summed = _weighted_rows(table_PD, nodes, shares)
    normal, mean, spread = torch.native_layer_norm(
        summed, gain.shape, gain, shift, NORM_EPS
    )
    hidden = normal.relu()
    to_normal = torch.ops.aten.threshold_backward(to_raw @ weight, hidden, 0)
    back = torch.ops.aten.native_layer_norm_backward(
        to_normal, summed, gain.shape, mean, spread, gain, shift, [True] * 3
    )
    return hidden, *back


def _parts(nodes: Tensor, table_PD: Tensor) -> list[slice]:
    """Cut relations into parts: on a CPU as many as its cache holds features of."""
    count = len(nodes)
    few = max(1, count)
    if nodes.device.type == "cpu":
        few = max(1, CACHED_NUMBERS // table_PD.shape[1])
    return [slice(start, min(start + few, count)) for start in range(0, count, few)]


def _weighted_rows(table_PD: Tensor, nodes: Tensor, shares: Tensor) -> Tensor:
    return functional.embedding_bag(nodes, table_PD, mode="sum", per_sample_weights=shares)


def _back_to_rows(pull: Tensor, nodes: Tensor, shares: Tensor, rows: int) -> Tensor:
    """Pull gradients [N, D] of weighted rows back to the table [rows, D].

    The same sum the other way round: every row of the table collects those it was part of.
    """
    ordered, order = nodes.flatten().sort(stable=True)
    ends = torch.arange(rows, device=nodes.device)
    return functional.embedding_bag(
        order // nodes.shape[1],
        pull,
        torch.searchsorted(ordered, ends),
        mode="sum",
        per_sample_weights=shares.flatten()[order],
    )


def _back_in_segments(pull: Tensor, nodes: Tensor, shares: Tensor, rows: int) -> Tensor:
    """The same sum for a GPU, where one thread would add up all of a row's pairs in turn.

    Thousands of pairs share the hottest row. The gradient of a bag of embeddings cuts such
    rows into segments, in a fixed order.
    """
    count, each = nodes.shape
    bag = torch.arange(count * each, device=nodes.device) // each
    sizes, most = nodes.new_full((count,), each), nodes.new_empty(0)
    table: Tensor = torch.ops.aten._embedding_bag_dense_backward(
        *(pull, nodes.flatten(), bag, sizes, most, rows, False, SUM, shares.flatten(), -1)
    )
    return table


def _through_norm(pull: Tensor, normal: Tensor) -> Tensor:
    """Pull a gradient through a norm without gain, but for the scale it divided by."""
    mean = pull.mean(dim=-1, keepdim=True)
    along = (pull * normal).mean(dim=-1, keepdim=True)
    return (pull - mean).addcmul_(normal, along, value=-1)


def _through_norm_at_once(pull: Tensor, normal: Tensor, scale: Tensor) -> Tensor:
    """The same with the scale, in fewer launches: the norm's input was like ``normal``."""
    like, mean = normal / scale, torch.zeros_like(scale)
    parts = pull, like, normal.shape[1:], mean, scale, None, None, [True, False, False]
    to_input: Tensor = torch.ops.aten.native_layer_norm_backward(*parts)[0]
    return to_input
