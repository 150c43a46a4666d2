"""Small parts the network is built from.

Shape letters: N targets, S slots of one target, K neighbours of a target, D width, R width
of relations, H heads, C width of one head, F scalars, P nodes of a table.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.attention.evaluation import Affine, EvaluationWeights, KeptFold
from infgen.model.attention.neighbour_attention import (
    Hiding,
    PairWeights,
    Shared,
    attend_to_pairs,
)
from infgen.model.settings import ModelSettings

FEED_FORWARD = 4
"""The feed-forward part is so many times as wide as the features."""


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a norm between: heads, and embeddings of one scalar."""
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.LayerNorm(width),
        nn.ReLU(),
        nn.Linear(width, outputs),
    )


def embedding_mlp(inputs: int, width: int) -> nn.Sequential:
    """Three linear layers with norms between: embeddings of several numbers."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.LayerNorm(width), nn.ReLU(), *mlp(width, width, width)
    )


def begin_last_at_zero(layers: nn.Sequential) -> None:
    """Set the last linear layer to zero, so that what it adds changes nothing at first."""
    last = layers[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)


def normed(x: Tensor) -> Tensor:
    """Bring features [..., D] to mean 0 and variance 1, without a learned gain."""
    return functional.layer_norm(x, x.shape[-1:])


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Compute logits in float32 under autocast too: rounded ones choose otherwise.

    With heads in bf16 one in four choices of motion tokens differs from float32; with heads
    in float32 it is one in 25 (``tests/rollout/test_precision``).
    """
    return torch.autocast(x.device.type, enabled=False)


def by_agent_type(
    rows: Tensor, agent_type: Tensor, products: Sequence[Callable[[Tensor], Tensor]]
) -> Tensor:
    """Compute of rows [N, ...] what is to be computed of those of their agent types.

    A CPU computes it of each row alone. Elsewhere, to know how many rows each type has, the
    host would wait; so there it is computed of all rows for every type.

    Args:
        rows: Of agents.
        agent_type: ``AgentType`` of each [N].
        products: One for each type.
    """
    if rows.device.type != "cpu":
        found = torch.zeros((), dtype=rows.dtype, device=rows.device)
        for each, product in enumerate(products):
            found = torch.where((agent_type == each)[:, None], product(rows), found)
        return found
    places = [(agent_type == each).nonzero()[:, 0] for each in range(len(products))]
    parts = [product(rows[at]) for at, product in zip(places, products, strict=True)]
    return torch.cat(parts)[torch.cat(places).argsort()]


def gather(features_ND: Tensor, index: Tensor) -> Tensor:
    """Take rows of features by an index of any shape: [*index, D].

    An embedding look-up: its gradient is summed in order, on every device.
    """
    return functional.embedding(index, features_ND)


def initialise(module: nn.Module) -> None:
    """Xavier weights, zero biases, small embeddings (SPEC 4.1). For ``Module.apply``."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.Embedding):
        nn.init.normal_(module.weight, std=0.02)


def dropout_factors(like: Tensor, share: float) -> Tensor:
    """Draw 0 for about a share of the places, else what makes up for the zeros.

    One random byte decides a place, an eighth of the numbers that a draw for each would
    take; so the share is rounded to 1/256. A GPU draws as fast as it writes, with fewer
    launches. Factors are of the precision of the features, which so keep theirs.
    """
    cut = round(share * 256)
    if like.device.type != "cpu":
        kept = 1 - cut / 256
        return torch.empty_like(like).bernoulli_(kept).div_(kept)
    words = torch.empty(-(-like.numel() // 8), dtype=torch.int64, device=like.device)
    drawn = words.random_(-(1 << 63), None).view(torch.uint8)[: like.numel()]
    factors = (drawn.view(like.shape) >= cut).float().div_(1 - cut / 256)
    return factors.to(like.dtype)


class Dropout(nn.Module):
    """Forget some features while training, as ``dropout_factors`` draws them."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: Tensor) -> Tensor:
        """Drop features of any shape."""
        if not (self.training and self.share):
            return x
        if x.device.type != "cpu":
            found: Tensor = torch.native_dropout(x, round(self.share * 256) / 256, True)[0]
            return found
        return x * dropout_factors(x, self.share)


class FourierEmbedding(nn.Module):
    """A few scalars as one feature: each through learned waves and an MLP, then summed."""

    def __init__(self, scalars: int, bands: int, width: int) -> None:
        super().__init__()
        self.frequency = nn.Embedding(scalars, bands)
        self.scalars = nn.ModuleList(
            mlp(2 * bands + 1, width, width) for _ in range(scalars)
        )
        self.out = nn.Sequential(nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width))

    def scalar(self, number: int, value: Tensor) -> Tensor:
        """Embed one of the scalars: [...] to [..., D]."""
        phase = 2 * math.pi * value[..., None] * self.frequency.weight[number]
        waves = torch.cat([phase.cos(), phase.sin(), value[..., None]], dim=-1)
        embedded: Tensor = self.scalars[number](waves)
        return embedded

    def forward(self, values: Tensor, more: Tensor | None = None) -> Tensor:
        """Embed scalars [..., F], and add features [..., D] before the last layer."""
        parts = [self.scalar(i, values[..., i]) for i in range(len(self.scalars))]
        parts += [] if more is None else [more]
        embedded: Tensor = self.out(torch.stack(parts).sum(dim=0))
        return embedded


@dataclass(frozen=True, slots=True)
class AttentionSources:
    """What every target sees.

    Attributes:
        features: Normed features of all sources [M, D].
        index: Row of each neighbour among them [N, K].
        relation: Normed features of how neighbours stand to their target [N, K, R].
        present: Which neighbours there are: [N, K], or [N, S, K] if slots differ.
        turn: By what features are turned at the targets [N, P], if those of the sources are
            turned (``rotary.turns``).
        groups: Ranges of targets that see the same sources, as in ``attention.parts``.
    """

    features: Tensor
    index: Tensor
    relation: Shared
    present: Tensor
    turn: Tensor | None = None
    groups: tuple[slice, ...] | None = None

    @classmethod
    def own(
        cls, features_NKD: Tensor, relation: Shared, present: Tensor
    ) -> "AttentionSources":
        """Let every target see sources of its own [N, K, D]."""
        count = features_NKD.shape[:2].numel()
        index = torch.arange(count, device=present.device).view(features_NKD.shape[:2])
        return cls(features_NKD.flatten(0, 1), index, relation, present)

    def take(self, targets: Tensor) -> "AttentionSources":
        """Go on with some targets only; gradients end here."""
        relation = Shared.of(self.relation.values[targets])
        turn = None if self.turn is None else self.turn[targets]
        return AttentionSources(
            self.features, self.index[targets], relation, self.present[targets], turn
        )


class Attention(nn.Module):
    """Let targets look at their neighbours; gated update and feed-forward (SPEC 4.1).

    Keys and values are ``W x + V r`` for a neighbour's features x and relation r. They are
    never formed: the score ``q.(W x + V r)`` is ``(W'q).x + (V'q).r``, and the sum of
    values is ``W sum(a x) + V sum(a r)``. So the work per pair is two short products per
    head, and x and r, which many layers share, are all that is kept per pair. Gains and
    biases of the norms of x and r are folded into the weights. A target without neighbours
    still passes the gate and the feed-forward.
    """

    def __init__(self, settings: ModelSettings, *, bipartite: bool) -> None:
        super().__init__()
        width, heads, dropout = settings.width, settings.heads, settings.dropout
        relation_width = settings.relation_features
        self.heads = heads
        self.dropout = dropout
        self.norm_target = nn.LayerNorm(width)
        self.norm_source = nn.LayerNorm(width) if bipartite else None
        self.norm_relation = nn.LayerNorm(relation_width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width)
        self.relation_key = nn.Linear(relation_width, width, bias=False)
        self.relation_value = nn.Linear(relation_width, width, bias=False)
        self.gate = nn.Linear(2 * width, width)
        self.itself = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.norm_out = nn.LayerNorm(width)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, FEED_FORWARD * width),
            nn.ReLU(),
            Dropout(dropout),
            nn.Linear(FEED_FORWARD * width, width),
            nn.LayerNorm(width),
        )
        self._kept_fold: KeptFold | None = None
        self.fused: Callable[[Tensor, AttentionSources], Tensor] | None = None

    def train(self, mode: bool = True) -> "Attention":
        """Switch between training and evaluation; forget what was made of the weights."""
        self._kept_fold = None
        return super().train(mode)

    def forward(self, target: Tensor, seen: AttentionSources) -> Tensor:
        """Update targets [N, D], or [N, S, D] whose slots share their neighbours."""
        if self.fused is not None:
            return self.fused(target, seen)
        slots = target if target.dim() == 3 else target[:, None]
        if not (self.training or torch.is_grad_enabled()):
            return self._evaluated(slots, seen).view_as(target)
        normal = self.norm_target(slots)
        looked = self.look(normal, seen)
        gate = torch.sigmoid(self.gate(torch.cat([looked, normal], dim=-1)))
        update = looked + gate * (self.itself(normal) - looked)
        slots = slots + self.norm_out(self.out(update))
        slots = slots + self.feed_forward(slots)
        return slots.view_as(target)

    def _evaluated(self, slots: Tensor, seen: AttentionSources) -> Tensor:
        """Do the same in evaluation by fewer operations, which few targets consist of."""
        weights, (targets, count, width) = self._folded(), slots.shape
        own = weights.own.linear(normed(slots))
        query, gate, itself = torch.split(own, width, dim=-1)
        looked = attend_to_pairs(
            query.view(targets, count, self.heads, width // self.heads),
            weights.pairs,
            seen.features,
            seen.index,
            seen.relation,
            _hiding(seen),
            None,
            seen.turn,
            seen.groups,
        ).flatten(2)
        gate = (gate + functional.linear(looked, weights.gate)).sigmoid_()
        update = weights.out.linear(torch.lerp(looked, itself, gate))
        slots = slots + weights.norm_out.norm(update)
        norm, hidden, out, norm_out = weights.forward
        forward = out.linear(hidden.linear(norm.norm(slots)).relu_())
        return slots + norm_out.norm(forward)

    def look(self, normal_NSD: Tensor, seen: AttentionSources) -> Tensor:
        """Sum what each slot sees: [N, S, D]."""
        width = normal_NSD.shape[-1]
        query = self.query(normal_NSD).unflatten(-1, (self.heads, width // self.heads))
        looked = attend_to_pairs(
            query * query.shape[-1] ** -0.5,
            self._fold(),
            seen.features,
            seen.index,
            seen.relation,
            _hiding(seen),
            self._kept(query, seen.index.shape[-1]),
            seen.turn,
            seen.groups,
        )
        return looked.flatten(2)

    def _kept(self, query_NSHC: Tensor, neighbours: int) -> Tensor | None:
        """Factors of dropout on the weights of pairs, if there is any."""
        if not (self.training and self.dropout):
            return None
        like = query_NSHC.new_empty((*query_NSHC.shape[:3], neighbours))
        return dropout_factors(like, self.dropout)

    def source_norm(self) -> nn.LayerNorm:
        """Norm of the neighbours' features: the targets' own unless they differ."""
        return self.norm_target if self.norm_source is None else self.norm_source

    def _folded(self) -> EvaluationWeights:
        """Fold the norms into the weights: once, until the weights change."""
        # Fused optimizers write without a new version, but only in training.
        kept, first = self._kept_fold, self.key.weight
        autocast = torch.is_autocast_enabled(first.device.type)
        if kept is None or not kept.holds(first, autocast):
            weights = (first, *self.parameters())
            kept = KeptFold.of(weights, autocast, self._fold_all())
            self._kept_fold = kept
        return kept.folded

    def _fold_all(self) -> EvaluationWeights:
        """Fold the norms into the weights of pairs, and of the targets themselves."""
        width, pairs, norm = self.query.in_features, self._fold(), self.norm_target
        scale = (width // self.heads) ** -0.5
        of_looked, of_target = torch.split(self.gate.weight, width, dim=1)
        weight = torch.cat([self.query.weight * scale, of_target, self.itself.weight])
        bias = torch.cat([self.query.bias * scale, self.gate.bias, self.itself.bias])
        kind = pairs.value_bias.dtype  # Of a product: what autocast, if any, gives them.
        first, hidden, _, _, out, last = self.feed_forward
        return EvaluationWeights(
            own=Affine(weight * norm.weight, bias + weight @ norm.bias).to(kind),
            pairs=PairWeights(*(each.to(kind) for each in pairs)),
            gate=of_looked.to(kind).contiguous(),
            out=Affine.of(self.out).to(kind),
            norm_out=Affine.of(self.norm_out),
            forward=(
                Affine.of(first),
                Affine.of(hidden).to(kind),
                Affine.of(out).to(kind),
                Affine.of(last),
            ),
        )

    def _fold(self) -> PairWeights:
        """Fold the norms into the weights of keys and values."""
        source, relation = self.source_norm(), self.norm_relation
        gain = torch.cat([source.weight, relation.weight])
        key = torch.cat([self.key.weight, self.relation_key.weight], dim=1)
        value = torch.cat([self.value.weight, self.relation_value.weight], dim=1)
        bias = self.value(source.bias) + self.relation_value(relation.bias)
        return PairWeights(
            key=(key * gain).view(self.heads, -1, len(gain)),
            value=(value * gain).view(self.heads, -1, len(gain)),
            value_bias=bias.view(self.heads, -1),
        )


def _hiding(seen: AttentionSources) -> Hiding:
    """Say what targets do not see; made once for all blocks."""
    covers = seen.relation.covers
    if covers is None or covers[0] is not seen.present:
        present = seen.present if seen.present.dim() == 3 else seen.present[:, None]
        covers = seen.present, Hiding.of(present)
        object.__setattr__(seen.relation, "covers", covers)
    hiding: Hiding = covers[1]
    return hiding
