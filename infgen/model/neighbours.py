"""What agents and queries see of roads and of each other, as ``layers.AttentionSources``.

Shared by training (all tokens at once) and simulation (one token of many rollouts), so that
both see the same. Dims: group (a scene, a rollout, or one token of it), target, source.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.attention.neighbour_attention import Shared
from infgen.model.features.polyline_segments import PolylineSegments
from infgen.model.features.signals import StopLines
from infgen.model.layers import AttentionSources
from infgen.model.map_grid import MapGrid
from infgen.model.relations import (
    Relation,
    Rows,
    describe_pairs,
    nearest,
    within_radius,
)


@dataclass(frozen=True, slots=True)
class NeighbourSpec:
    """How far targets see, how many, and how what they see is embedded.

    Attributes:
        radius_m: Radius.
        count: Nearest sources that are seen.
        relation: How it is told how sources stand to targets.
        table: Its table.
        ahead_m: How far ahead of a target the point is that they are nearest to.
        across: Whether relations end in ``relations.across``.
    """

    radius_m: float
    count: int
    relation: Relation
    table: Tensor
    ahead_m: float
    across: bool

    @classmethod
    def of(
        cls,
        radius_m: float,
        count: int,
        relation: Relation,
        *,
        ahead_m: float = 0.0,
        across: bool = False,
    ) -> "NeighbourSpec":
        """Evaluate the relation's table for one pass."""
        return cls(radius_m, count, relation, relation.table(), ahead_m, across)

    def centre_m(self, pose: Float32[Tensor, "*target 3"]) -> Float32[Tensor, "*target 2"]:
        """Where targets look for sources."""
        if not self.ahead_m:
            return pose[..., :2]
        heading_rad = pose[..., 2]
        ahead = torch.stack([heading_rad.cos(), heading_rad.sin()], dim=-1)
        return pose[..., :2] + self.ahead_m * ahead

    def describe(
        self,
        target_pose: Float32[Tensor, "target 3"],
        source_pose: Float32[Tensor, "target neighbour 3"],
    ) -> Shared:
        """Normed features of how sources stand to their targets."""
        return Shared.of(
            describe_pairs(
                self.relation, self.table, target_pose, source_pose, lateral=self.across
            )
        )


@dataclass(frozen=True, slots=True)
class NeighbourRows:
    """Neighbours of each row, not yet with features.

    Attributes:
        index: Rows of the neighbours [N, K].
        relation: Normed features of how they stand to it [N, K, D].
        present: Which of them there are [N, K].
        place: Position of each neighbour among its group's sources [N, K].
        turn: By what the features of the row itself are turned [N, P], if they are.
        groups: Ranges of rows that see the same ones, as in ``attention.parts``.
    """

    index: Tensor
    relation: Shared
    present: Tensor
    place: Tensor
    turn: Tensor | None
    groups: tuple[slice, ...] | None = None

    def seen(self, features: Tensor) -> AttentionSources:
        """Join with the features of all rows [row, D], which are turned if any are."""
        return AttentionSources(
            features, self.index, self.relation, self.present, self.turn, self.groups
        )


@dataclass(frozen=True, slots=True)
class MapFeatures:
    """Encoded maps, one after the other.

    Attributes:
        rows: Which places of the padded maps they are.
        features: Normed features [row, D].
        turned: The same as attention sees them: turned, if they are.
        pose: Poses of the padded maps [scene, road, 3].
        real: Which places of the padded maps hold a map token [scene, road].
        grid: The same tokens by where they are.
        signal_states: What those with a traffic light look like, if that is seen as it
            changes.
        lines: Stop lines of signals, if agents get the signal ahead as a feature.
        edges: Road edges, if motion tokens or offset bins are judged by them.
        lanes: Lanes, if headings of inserted agents are.
    """

    rows: Rows
    features: Tensor
    turned: Tensor
    pose: Tensor
    real: Tensor
    grid: MapGrid
    signal_states: "SignalStates | None"
    lines: StopLines | None
    edges: PolylineSegments | None
    lanes: PolylineSegments | None

    def at(self, scene: Tensor, place: Tensor, token: Tensor | None) -> Tensor:
        """Rows [N, K] of the features of places [N, K] of maps [N], at token steps [N]."""
        row = self.rows.number[scene[:, None], place]
        if self.signal_states is None or token is None:
            return row
        return self.signal_states.lit(row, scene, place, token)


@dataclass(frozen=True, slots=True)
class SignalStates:
    """Map tokens as they look under each class of light: rows behind those of the maps.

    Attributes:
        first: Row of the first class of each map token's looks [row].
        light: Its light, counted from 1; 0 for none [scene, road].
        shown: ``SignalClass`` of those by the token step, ``REMEMBERED`` or not; the last
            one lasts [scene, light, token].
    """

    first: Tensor
    light: Tensor
    shown: Tensor

    def lit(self, row: Tensor, scene: Tensor, place: Tensor, token: Tensor) -> Tensor:
        """Rows of map tokens under their lights at token steps [N]; others as given."""
        if not self.shown.numel():
            return row
        scene = scene[:, None]
        light, token = self.light[scene, place], token.clamp(max=self.shown.shape[2] - 1)
        shown = self.shown[scene, (light - 1).clamp(min=0), token[:, None]]
        return torch.where(light > 0, self.first[row] + shown, row)


def find_neighbours(
    reach: NeighbourSpec,
    targets: Rows,
    target_pose: Float32[Tensor, "group target 3"],
    source_pose: Float32[Tensor, "group source 3"],
    source_row: Int64[Tensor, "group source"],
    allowed: Bool[Tensor, " group #target source"],
) -> NeighbourRows:
    """Find what every target row sees of its group's sources.

    Args:
        reach: How far and how many.
        targets: Which places of [group, target] are rows.
        target_pose: Poses of targets.
        source_pose: Poses of sources.
        source_row: Row of each source in the features it will be joined with.
        allowed: Which sources each target may see.
    """
    found = nearest(
        reach.centre_m(target_pose),
        source_pose[..., :2],
        allowed,
        reach.radius_m,
        reach.count,
    )
    place, present = targets.pack(found.index), targets.pack(found.present)
    group = (targets.at // found.index.shape[1])[:, None]
    pose = targets.pack(target_pose)
    return NeighbourRows(
        index=source_row[group, place],
        relation=reach.describe(pose, source_pose[group, place]),
        present=present,
        place=place,
        turn=reach.relation.turn(pose),
    )


def find_others(
    reach: NeighbourSpec,
    rows: Rows,
    pose: Float32[Tensor, "group place 3"],
    visible: Bool[Tensor, "group place"],
) -> NeighbourRows:
    """Find what every row sees of the other rows of its group.

    Where a group has no more rows than are seen, and on a CPU, all of its rows are listed
    in order: so one product does for the whole group, and nothing is gathered.

    Args:
        reach: How far and how many; looking from where they are, not ahead.
        rows: The visible places.
        pose: Poses of all places.
        visible: Which places hold an agent.
    """
    if visible.device.type == "cpu":
        sizes = visible.sum(dim=1)
        if len(rows.at) and int(sizes.max()) <= reach.count + 1:
            return _whole_groups(reach, rows, pose, sizes)
    others = ~torch.eye(visible.shape[1], dtype=torch.bool, device=visible.device)
    allowed = visible[:, None] & visible[:, :, None] & others
    return find_neighbours(reach, rows, pose, pose, rows.number, allowed)


def _whole_groups(
    reach: NeighbourSpec, rows: Rows, pose: Tensor, sizes: Tensor
) -> NeighbourRows:
    """List all rows of each group for each of its rows; they are there if they are seen."""
    own, ends = rows.pack(pose), sizes.cumsum(dim=0)
    group = rows.at // pose.shape[1]
    listed = torch.arange(int(sizes.max()))
    first = (ends - sizes)[group, None]
    index = (first + listed).clamp(max=len(own) - 1)
    others = own[index]
    present = (listed < sizes[group, None]) & (index != torch.arange(len(own))[:, None])
    present &= within_radius(own[:, None].expand_as(others), others, reach.radius_m)
    starts = (ends - sizes).tolist()
    return NeighbourRows(
        index=index,
        relation=reach.describe(own, others),
        present=present,
        place=rows.at[index] % pose.shape[1],
        turn=reach.relation.turn(own),
        groups=tuple(
            slice(start, end)
            for start, end in zip(starts, ends.tolist(), strict=True)
            if end > start
        ),
    )


def find_map_neighbours(
    reach: NeighbourSpec,
    targets: Rows,
    target_pose: Float32[Tensor, "group target 3"],
    roads: MapFeatures,
    scene: Int64[Tensor, " group"],
    token: Int64[Tensor, " row"] | None = None,
) -> AttentionSources:
    """Show every target row the map tokens around it.

    Args:
        reach: How far and how many.
        targets: Which places of [group, target] are rows.
        target_pose: Poses of targets.
        roads: All maps.
        scene: Each group's map.
        token: Half second of each row: it sees the lights of then. Without, it sees none.
    """
    pose, on = targets.pack(target_pose), scene[targets.at // target_pose.shape[1]]
    found = roads.grid.nearest(reach.centre_m(pose), on, reach.radius_m, reach.count)
    place, present = found.index[0], found.present[0]
    return AttentionSources(
        roads.turned,
        roads.at(on, place, token),
        reach.describe(pose, roads.pose[on[:, None], place]),
        present,
        reach.relation.turn(pose),
    )


def cell_pose(
    ego_pose: Float32[Tensor, "*row 3"], centre_m: Float32[Tensor, "*row 2"]
) -> Float32[Tensor, "*row 3"]:
    """Poses at the centres of cells (ego's grid frame), facing as the ego does."""
    turn_rad = ego_pose[..., 2] - math.pi / 2
    cos, sin = turn_rad.cos(), turn_rad.sin()
    x_m = cos * centre_m[..., 0] - sin * centre_m[..., 1] + ego_pose[..., 0]
    y_m = sin * centre_m[..., 0] + cos * centre_m[..., 1] + ego_pose[..., 1]
    return torch.stack([x_m, y_m, ego_pose[..., 2]], dim=-1)


def grid_place(pose: Tensor, ego_pose: Tensor) -> Float32[Tensor, "*row 2"]:
    """Where poses [..., 3] are in the ego's grid frame. Inverse of ``cell_pose``."""
    turn_rad = math.pi / 2 - ego_pose[..., 2]
    cos, sin = turn_rad.cos(), turn_rad.sin()
    x_m, y_m = (pose - ego_pose)[..., :2].unbind(-1)
    return torch.stack([cos * x_m - sin * y_m, sin * x_m + cos * y_m], dim=-1)
