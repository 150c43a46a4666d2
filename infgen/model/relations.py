"""Neighbours within a radius, and relative position features.

Neighbour lists are padded rows of the nearest sources within a radius: no edge lists, no
order that depends on the device. Nothing here is learned and nothing is differentiated.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn import functional

from infgen.model.relation_tables import RelationEmbedding, Span
from infgen.model.rotary.coordinates import coordinates
from infgen.model.rotary.relation import RotaryRelation
from infgen.model.settings import ModelSettings

BLOCK_PAIRS = 1 << 17
"""Distances held at once on a CPU while neighbours are searched: some of its cache ..."""
DEVICE_BLOCK_PAIRS = 1 << 26
"""... and elsewhere, where every block costs launches: some of the memory."""
SQUARE_PER_M2 = 1024
"""Squared distances are compared in units of 1/1024 m2, so that rounding makes no order."""
INDEX_BITS = 20
NO_DIRECTION_M = 0.01
"""Nearer points have no direction: rounding would decide it."""

Relation = RelationEmbedding | RotaryRelation
"""How one family of relative poses is told."""

_NOBODY = 1 << 62

ANGLE_NODES = 1025
DISTANCE_STEP_M = 0.05
"""Between two nodes of the tables of distances."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The places of a padded array that hold something, as consecutive rows.

    Attributes:
        at: Flat index of each row in the padded array.
        number: Row of each place of the padded array; 0 where there is none.
    """

    at: Int64[Tensor, " row"]
    number: Int64[Tensor, "..."]

    @classmethod
    def where(cls, real: Bool[Tensor, "..."]) -> "Rows":
        """Number the true places of a mask in order; the host waits for their number."""
        at = real.flatten().nonzero()[:, 0]
        number = torch.zeros(real.numel(), dtype=torch.int64, device=real.device)
        number[at] = torch.arange(len(at), device=real.device)
        return cls(at, number.view(real.shape))

    def pack(self, padded: Tensor) -> Tensor:
        """Take the rows out of an array whose first dimensions are the mask's."""
        return padded.flatten(0, self.number.dim() - 1)[self.at]

    def spread(self, rows: Tensor) -> Tensor:
        """Put rows back to their places, zeros elsewhere. Inverse of ``pack``."""
        padded = rows.new_zeros((self.number.numel(), *rows.shape[1:]))
        padded = padded.index_copy(0, self.at, rows)
        return padded.view(*self.number.shape, *rows.shape[1:])


@dataclass(frozen=True, slots=True)
class Neighbours:
    """The nearest sources of every target.

    Attributes:
        index: Position among the group's sources; 0 where there is none.
        present: Which of them there are, nearest first.
    """

    index: Int64[Tensor, "group target neighbour"]
    present: Bool[Tensor, "group target neighbour"]


@torch.no_grad()
def nearest(
    target_xy_m: Float32[Tensor, "group target 2"],
    source_xy_m: Float32[Tensor, "group source 2"],
    allowed: Bool[Tensor, " group #target source"],
    radius_m: float,
    count: int,
) -> Neighbours:
    """Find the ``count`` nearest allowed sources within a radius; ties by position."""
    groups, targets = target_xy_m.shape[:2]
    sources = source_xy_m.shape[1]
    count = min(count, sources)
    if not count or not targets or not groups:
        empty = torch.zeros((groups, targets, 0), dtype=torch.int64)
        empty = empty.to(target_xy_m.device)
        return Neighbours(empty, empty.bool())
    allowed = allowed.expand(groups, targets, sources)
    block = block_length(groups * sources, target_xy_m.device)
    parts = [
        _nearest_keys(
            target_xy_m[:, at : at + block],
            source_xy_m,
            allowed[:, at : at + block],
            radius_m,
            count,
        )
        for at in range(0, targets, block)
    ]
    return _decode_keys(torch.cat(parts, dim=1))


@torch.no_grad()
def nearest_listed(
    parts: Iterable[tuple[Tensor, Tensor, Tensor, Tensor]], radius_m: float, count: int
) -> Neighbours:
    """Find the ``count`` nearest within a radius among sources listed for each target.

    Args:
        parts: Some targets at a time: where they are [target, 2], where their sources are
            [target, listed, 2], the sources' positions [target, listed], by which ties go,
            and which there are [target, listed].
        radius_m: Radius.
        count: How many.

    Returns:
        Neighbours of a single group: positions as listed.
    """
    keys = []
    for target_xy_m, source_xy_m, position, there in parts:
        x_m, y_m = (target_xy_m[:, None] - source_xy_m).unbind(-1)
        square = _whole_units(x_m, y_m)
        hidden = (square > _square_limit(radius_m)) | ~there
        key = square.mul_(1 << INDEX_BITS).add_(position).masked_fill_(hidden, _NOBODY)
        key = functional.pad(key, (0, max(0, count - key.shape[1])), value=_NOBODY)
        keys.append(key.topk(count, dim=-1, largest=False).values)
    return _decode_keys(torch.cat(keys)[None])


def block_length(pairs: int, device: torch.device) -> int:
    """How many targets to search at once, by the pairs that each of them makes."""
    held = BLOCK_PAIRS if device.type == "cpu" else DEVICE_BLOCK_PAIRS
    return max(1, held // pairs)


def _decode_keys(key: Tensor) -> Neighbours:
    """Decode keys [group, target, neighbour] to neighbour rows."""
    present = key < _NOBODY
    if key.device.type == "cpu":
        # The rest would be padding for everyone. Elsewhere the host would wait to know.
        most = int(present.sum(dim=-1).max()) if key.numel() else 0
        key, present = key[..., :most], present[..., :most]
    index = torch.where(present, key & ((1 << INDEX_BITS) - 1), 0)
    return Neighbours(index, present)


def within_radius(
    pose: Float32[Tensor, "*pair 3"], other: Float32[Tensor, "*pair 3"], radius_m: float
) -> Bool[Tensor, "*pair"]:
    """Tell which poses are within a radius, exactly as ``nearest`` does."""
    return _square(pose[..., :2] - other[..., :2]) <= _square_limit(radius_m)


def _square(away_m: Tensor) -> Tensor:
    """Squared distances in whole units."""
    return _whole_units(away_m[..., 0], away_m[..., 1])


def _whole_units(x_m: Tensor, y_m: Tensor) -> Tensor:
    """Squared lengths in whole units: a new tensor, made with few passes over memory."""
    square = (x_m * x_m).addcmul_(y_m, y_m)
    return square.mul_(SQUARE_PER_M2).round_().long()


def _square_limit(radius_m: float) -> int:
    return round(radius_m**2 * SQUARE_PER_M2)


def _nearest_keys(
    target_xy_m: Tensor, source_xy_m: Tensor, allowed: Tensor, radius_m: float, count: int
) -> Tensor:
    """Smallest keys [group, target, count]: squared distance, then position."""
    x_m, y_m = (
        target_xy_m[:, :, None, axis] - source_xy_m[:, None, :, axis] for axis in (0, 1)
    )
    square = _whole_units(x_m, y_m)  # [group, target, source]; changed in place below
    hidden = (square > _square_limit(radius_m)) | ~allowed
    position = torch.arange(source_xy_m.shape[1], device=square.device)
    key = square.mul_(1 << INDEX_BITS).add_(position).masked_fill_(hidden, _NOBODY)
    return key.topk(count, dim=-1, largest=False).values


def wrap_angle(angle_rad: Tensor) -> Tensor:
    """Bring angles to [-pi, pi]."""
    turns = (angle_rad / (2 * math.pi)).round_()
    return angle_rad - turns.mul_(2 * math.pi)


def direction(away_m: Float32[Tensor, "*pair 2"], heading_rad: Tensor) -> Tensor:
    """Direction [*pair] of displacements, seen from a heading; 0 where there is none."""
    angle_rad = torch.atan2(away_m[..., 1], away_m[..., 0])
    none = away_m.square().sum(dim=-1) <= NO_DIRECTION_M**2
    return wrap_angle(angle_rad - heading_rad).masked_fill_(none, 0.0)


@torch.no_grad()
def relations(
    target_pose: Float32[Tensor, "target 3"],
    source_pose: Float32[Tensor, "target neighbour 3"],
) -> Float32[Tensor, "target neighbour 3"]:
    """Describe neighbours to their target: distance, direction, relative heading."""
    x_m, y_m = (source_pose[..., :2] - target_pose[:, None, :2]).unbind(dim=-1)
    square_m2 = (x_m * x_m).add_(y_m * y_m)
    angles_rad = torch.stack([torch.atan2(y_m, x_m), source_pose[..., 2]])
    direction_rad, turned_rad = wrap_angle(angles_rad.sub_(target_pose[:, None, 2]))
    direction_rad.masked_fill_(square_m2 <= NO_DIRECTION_M**2, 0.0)
    return torch.stack([square_m2.sqrt_(), direction_rad, turned_rad], dim=-1)


@torch.no_grad()
def across(
    target_pose: Float32[Tensor, "target 3"],
    source_pose: Float32[Tensor, "target neighbour 3"],
) -> Float32[Tensor, "target neighbour 1"]:
    """How far to the left of each neighbour, as that one faces, the target is."""
    away_m = target_pose[:, None, :2] - source_pose[..., :2]
    heading_rad = source_pose[..., 2]
    left_m = heading_rad.cos() * away_m[..., 1] - heading_rad.sin() * away_m[..., 0]
    return left_m[..., None]


def describe_pairs(
    relation: Relation,
    table: Tensor,
    target_pose: Float32[Tensor, "target 3"],
    source_pose: Float32[Tensor, "target neighbour 3"],
    *,
    ago: Float32[Tensor, "target neighbour"] | None = None,
    lateral: bool = False,
) -> Float32[Tensor, "target neighbour feature"]:
    """Describe how neighbours stand to their targets, as attention reads it.

    Args:
        relation: Of this family of relations ...
        table: ... and its table.
        target_pose: Poses of targets.
        source_pose: Poses of the neighbours of each.
        ago: Token steps since the neighbours' times, negative, if they differ.
        lateral: Whether relations end in ``across``.
    """
    if isinstance(relation, RotaryRelation):
        return coordinates(target_pose, source_pose, ago)
    described = relations(target_pose, source_pose)
    if ago is not None:
        described = torch.cat([described, ago[..., None]], dim=-1)
    if lateral:
        described = torch.cat([described, across(target_pose, source_pose)], dim=-1)
    return relation.look_up(described, table)


def turn_of_rows(relation: Relation, rows: Rows, pose: Tensor) -> Tensor | None:
    """By what the features of rows are turned, given padded poses; None if by nothing."""
    return relation.turn(rows.pack(pose)) if isinstance(relation, RotaryRelation) else None


def relation_embedding(
    radius_m: float,
    settings: ModelSettings,
    past_tokens: int = 0,
    *,
    across: bool = False,
) -> Relation:
    """Make what tells one family of relations.

    Args:
        radius_m: Largest distance that its table resolves.
        settings: Frequencies per scalar, and the width of the features.
        past_tokens: If not 0, relations end in a time difference of -1 to so many tokens.
        across: Whether they end in ``across``.
    """
    if settings.relations == "rotary":
        return RotaryRelation(settings.width)
    turn = Span(-math.pi, math.pi, ANGLE_NODES, closed=True)
    nodes = math.ceil(radius_m / DISTANCE_STEP_M) + 1
    spans = [Span(0.0, radius_m, nodes), turn, turn]
    if past_tokens:
        # One node more than there are tokens, so that a window of one is a range too.
        spans.append(Span(-float(past_tokens), 0.0, past_tokens + 1))
    if across:
        spans.append(Span(-radius_m, radius_m, 2 * nodes - 1))
    return RelationEmbedding(spans, settings.fourier_bands, settings.relation_features)
