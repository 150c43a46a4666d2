"""Inserted agents beside road edges and lanes: logits of offset bins and of headings.

Both are judged by what each map token around has to say (``detail_features``), added up. Of
two segments of an edge that meet, and of those of the other side of the street, the nearest
one decides; so it is with lanes of both directions side by side. Here the distance of each
offset bin from the nearest road edge is known, and the angle of each heading to the lanes
at the place.

Shape letters as in ``layers``.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from infgen.model.features.edge_clearance import EdgesNear
from infgen.model.features.polyline_segments import PolylineSegments
from infgen.model.insertion.detail_features import between_knots
from infgen.model.neighbours import MapFeatures, cell_pose
from infgen.model.relations import wrap_angle
from infgen.tokens.grid import Grid

OVER_REACH_M = 4.0
OVER_STEP_M = 0.25
"""Distances from the nearest edge are told apart so finely, so far on either side."""
LANES = 8
"""Segments of lanes that may be at a place: those with the nearest middles ..."""
LANES_REACH_M = 6.0
"""... within so much ..."""
ON_LANE_M = 2.0
"""... and of these, those that pass it as near as that."""
ANGLE_STEPS = 12
"""Angles to lanes are told apart by so many steps, from along them to against them."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where agents are inserted.

    Attributes:
        pose: Poses of the queries: at the centre of the cell, facing as the ego [N, 3].
        scene: Map of each.
        edges: Road edges of the maps ...
        lanes: ... and their lanes.
    """

    pose: Float32[Tensor, "row 3"]
    scene: Int64[Tensor, " row"]
    edges: PolylineSegments
    lanes: PolylineSegments

    @classmethod
    def on(cls, roads: MapFeatures, pose: Tensor, scene: Tensor) -> "Places":
        """Put places on encoded maps."""
        assert roads.edges is not None
        assert roads.lanes is not None
        return cls(pose, scene, roads.edges, roads.lanes)


class PlacementFeatures(nn.Module):
    """What queries make of road edges and lanes at the places of inserted agents."""

    points: Tensor
    heading_rad: Tensor

    def __init__(self, width: int, grid: Grid) -> None:
        super().__init__()
        right_m, ahead_m = grid.offset_m.T
        none = np.zeros_like(right_m)
        points = np.stack([ahead_m, -right_m, none, none, none - 1]).astype(np.float32)
        self.register_buffer("points", torch.from_numpy(points)[None], persistent=False)
        heading_rad = torch.from_numpy(grid.heading_centre_rad.copy())
        self.register_buffer("heading_rad", heading_rad, persistent=False)
        self.over_steps = round(2 * OVER_REACH_M / OVER_STEP_M)
        self.over = nn.Linear(width, self.over_steps + 1)
        self.angle = nn.Linear(width, ANGLE_STEPS + 1)

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        for part in (self.over, self.angle):
            nn.init.zeros_(part.weight)
            nn.init.zeros_(part.bias)

    def offsets(self, x_ND: Tensor, places: Places) -> Float32[Tensor, "row offset"]:
        """Say how much queries are for offset bins, by distance over the nearest edge."""
        over_m = self.over_m(places.pose, places.scene, places.edges)
        at = (over_m.clamp(-OVER_REACH_M, OVER_REACH_M) + OVER_REACH_M) / OVER_STEP_M
        return between_knots(self.over(x_ND).float(), at)

    @torch.no_grad()
    def over_m(
        self, pose: Tensor, scene: Tensor, edges: PolylineSegments
    ) -> Float32[Tensor, "row offset"]:
        """Say how far offset bins are over the nearest edge; negative on the road."""
        no_size_m = torch.zeros_like(pose[:, :2])
        near = EdgesNear.of(edges, pose, no_size_m, no_size_m, scene)
        return near.over_m(self.points)

    def headings(
        self, x_ND: Tensor, places: Places, offset_m: Float32[Tensor, "row 2"]
    ) -> Float32[Tensor, "row heading"]:
        """Say how much queries are for headings, by their angles to the lanes there.

        To the lane nearest in angle; zero where no lane is. ``offset_m`` is how far agents
        are from the centres of their cells, in the grid frame.
        """
        pose = cell_pose(places.pose, offset_m)
        turned_rad = self.turned_rad(pose, places.scene, places.lanes)
        there = turned_rad.isfinite()
        at = torch.where(there, turned_rad, 0) * (ANGLE_STEPS / math.pi)
        return between_knots(self.angle(x_ND).float(), at) * there

    @torch.no_grad()
    def turned_rad(
        self, pose: Tensor, scene: Tensor, lanes: PolylineSegments
    ) -> Float32[Tensor, "row heading"]:
        """Say how far headings are turned from the lane nearest in angle; inf for none."""
        found = lanes.grid.nearest(pose[:, :2], scene, LANES_REACH_M, LANES)
        at, present = found.index[0], found.present[0]
        away_m = pose[:, None, :2] - lanes.start_m[scene[:, None], at]
        along_m = lanes.along_m[scene[:, None], at]
        length_m2 = along_m.square().sum(dim=-1).clamp(min=1e-6)
        share = ((away_m * along_m).sum(dim=-1) / length_m2).clamp(0, 1)
        beside_m = (away_m - share[..., None] * along_m).norm(dim=-1)
        present = present & (beside_m <= ON_LANE_M)
        lane_rad = torch.atan2(along_m[..., 1], along_m[..., 0]) - pose[:, None, 2]
        turned_rad = wrap_angle(self.heading_rad - lane_rad[..., None]).abs()
        turned_rad = torch.where(present[..., None], turned_rad, torch.inf)
        none = turned_rad.new_full((len(pose), 1, len(self.heading_rad)), torch.inf)
        return torch.cat([turned_rad, none], dim=1).amin(dim=1)
