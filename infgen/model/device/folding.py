"""Weights of all attention blocks, with their norms folded in, by a few launches.

Shape letters as in ``device.attention``; B is the number of blocks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.layers import Attention

ALIGNED = 8
"""Columns that hold the sum of the weights of pairs, and zeros."""
OWN = ("query", "gate", "itself")
"""Layers that a block applies to its targets; gates see them behind what they saw."""


class Folded(NamedTuple):
    """Weights of a block in the type of products.

    Attributes:
        query: From a normed target to its query [D, D] ...
        query_bias: ... with its bias [D].
        wide: From a head of a query to features and relations [H, C, D + R].
        value: From what a query sees to a head of its value [H, E, C].
        gate: From what a target saw and is to its gate, and to what lies between what it
            saw and its own value [2 D, 2 D] ...
        gate_bias: ... with their biases.
        hidden: From a target to the hidden layer of the feed-forward part [4 D, D] ...
        hidden_bias: ... with its bias.
        out: From there back [D, 4 D] ...
        out_bias: ... with its bias.
    """

    query: Tensor
    query_bias: Tensor
    wide: Tensor
    value: Tensor
    gate: Tensor
    gate_bias: Tensor
    hidden: Tensor
    hidden_bias: Tensor
    out: Tensor
    out_bias: Tensor


def fold(blocks: Sequence[Attention]) -> list[Folded]:
    """Fold blocks of one shape, those without a norm for sources first."""
    width, heads = blocks[0].query.in_features, blocks[0].heads
    shape = (len(blocks), heads, width // heads, -1)
    target, source = _norms(blocks)
    wide, value, value_bias = _seen(blocks, source)
    of_saw, own, own_bias = _own(blocks, target)
    query, itself = torch.split(own, [width, 2 * width], dim=1)
    query_bias, gate_bias = torch.split(own_bias, [width, 2 * width], dim=1)
    less = torch.eye(width, device=own.device).neg_().expand(len(blocks), -1, -1)
    gate = torch.cat([torch.cat([of_saw, less], dim=1), itself], dim=2)
    value = torch.cat([value, value_bias], dim=2)
    parts = (
        *(query, query_bias, wide.view(shape)),
        functional.pad(value, (0, ALIGNED - 1)).view(shape).mT,
        *(gate, gate_bias),
        *(_of_all([block.feed_forward[1] for block in blocks])),
        *(_of_all([block.feed_forward[4] for block in blocks])),
    )
    kind = value_bias.dtype  # Of a product: what autocast, if any, gives to products.
    cut = zip(*(part.to(kind).unbind() for part in parts), strict=True)
    return [Folded(*each) for each in cut]


def _of_all(layers: Sequence[nn.Module]) -> tuple[Tensor, Tensor]:
    """Weights and biases of layers or norms."""
    weight, bias = (
        torch.stack([layer.get_parameter(name) for layer in layers])
        for name in ("weight", "bias")
    )
    return weight, bias


def _norms(
    blocks: Sequence[Attention],
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Gains and biases [B, D] of the norms of targets, and of those of sources."""
    target = _of_all([block.norm_target for block in blocks])
    more = [block.norm_source for block in blocks if block.norm_source is not None]
    if not more:
        return target, target
    shared = len(blocks) - len(more)
    both = zip(target, _of_all(more), strict=True)
    return target, tuple(torch.cat([one[:shared], other]) for one, other in both)


def _seen(
    blocks: Sequence[Attention], source: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Keys and values [B, D, D + R] of features and relations, and their biases."""
    relation = _of_all([block.norm_relation for block in blocks])
    gain, shift = (torch.cat(pair, dim=1) for pair in zip(source, relation, strict=True))
    key, value = (
        torch.cat(
            [torch.stack([getattr(b, name).weight for b in blocks]) for name in pair], 2
        )
        for pair in (("key", "relation_key"), ("value", "relation_value"))
    )
    bias = torch.stack([block.value.bias for block in blocks])[..., None]
    bias = torch.baddbmm(bias, value, shift[..., None])
    scale = (blocks[0].query.in_features // blocks[0].heads) ** -0.5
    return key * (gain * scale)[:, None], value * gain[:, None], bias


def _own(
    blocks: Sequence[Attention], target: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gates of what targets saw [B, D, D]; queries, gates and own values of what they are.

    The latter, one after the other [B, 3 D, D], are of normed targets; with their biases.
    """
    width, (gain, shift) = blocks[0].query.in_features, target
    weights, biases = zip(
        *(_of_all([getattr(block, name) for block in blocks]) for name in OWN), strict=True
    )
    of_saw, of_itself = weights[1].split(width, dim=2)
    weight = torch.cat([weights[0], of_itself, weights[2]], dim=1)
    bias = torch.cat(biases, dim=1)[..., None]
    bias = torch.baddbmm(bias, weight, shift[..., None])[..., 0]
    return of_saw, weight * gain[:, None], bias
