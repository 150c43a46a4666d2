"""Clearance of motion tokens from road edges: whether each of them leads off the road.

Agents see road edges as map tokens among many others. Here the front and the rear of an
agent's box are moved on by a motion token, and how far they are over the nearest road edge
is a feature of the token (``anchors``).

Shape letters as in ``anchors``; E edges of each agent.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.features.anchors import AnchorHead, Anchors, row_parts
from infgen.model.features.polyline_segments import PolylineSegments
from infgen.model.layers import full_precision
from infgen.tokens.vocabulary import MotionVocabulary

EDGES = 16
"""Edges that an agent keeps clear of: those nearest to where it would be next ..."""
REACH_M = 20.0
"""... within so much."""
POINTS = ((0.5, 1.0), (0.5, -1.0), (1.0, 1.0))
"""When the front (1) or the rear (-1) of the box is looked at, from the beginning of the
motion token."""
KNOTS_M = (-3.0, -1.5, -0.75, -0.25, 0.0, 0.25, 0.75, 2.0)
"""Between how far boxes are over an edge: how much of each interval is passed is told."""
NOW = (((0, 0), (0, 0), (1, -1), (0, 0), (-1, -1)),)
"""The front and the rear where the box is now [1, 5, 2]; see ``EdgesNear.over_m``."""
ALONG_ITS_SIDE = 1e-2
"""Of two edges as far away, which meet in a corner, the one that has it more to its side
tells on which side of the corner a point is."""


@dataclass(frozen=True, slots=True)
class EdgesNear:
    """Edges near agents, as the agents see them.

    Attributes:
        told: Their directions, the same times half of the length between the middles of an
            agent's front and rear, and where they begin along themselves [N, E, 5] ...
        aside: ... and the same to their left.
        length_m: Lengths [N, E].
        present: Which there are [N, E].
        half_width_m: Half of the widths of the agents [N].
    """

    told: Float32[Tensor, "row edge 5"]
    aside: Float32[Tensor, "row edge 5"]
    length_m: Float32[Tensor, "row edge"]
    present: Bool[Tensor, "row edge"]
    half_width_m: Float32[Tensor, " row"]

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        edges: PolylineSegments,
        pose: Float32[Tensor, "row 3"],
        step_m: Float32[Tensor, "row 2"],
        size_lw_m: Float32[Tensor, "row 2"],
        scene: Int64[Tensor, " row"],
    ) -> "EdgesNear":
        """Find the edges nearest to where agents would be next if they moved on.

        Args:
            edges: The edges.
            pose: Poses of the agents.
            step_m: Displacements in the last token step.
            size_lw_m: Boxes.
            scene: Map of each.
        """
        found = edges.grid.nearest(pose[:, :2] + step_m, scene, REACH_M, EDGES)
        at, present = found.index[0], found.present[0]
        start_m = edges.start_m[scene[:, None], at] - pose[:, None, :2]
        along_m = edges.along_m[scene[:, None], at]
        length_m = along_m.square().sum(dim=-1).sqrt().clamp(min=1e-3)
        cos, sin = pose[:, None, 2].cos(), pose[:, None, 2].sin()
        x, y = (along_m / length_m[..., None]).unbind(-1)
        x, y = cos * x + sin * y, cos * y - sin * x
        start_x_m, start_y_m = start_m.unbind(-1)
        start_x_m, start_y_m = (
            cos * start_x_m + sin * start_y_m,
            cos * start_y_m - sin * start_x_m,
        )
        half_m = ((size_lw_m[:, 0] - size_lw_m[:, 1]) / 2).clamp(min=0)[:, None]
        told = [x, y, half_m * x, half_m * y, x * start_x_m + y * start_y_m]
        aside = [-y, x, -half_m * y, half_m * x, x * start_y_m - y * start_x_m]
        return cls(
            torch.stack(told, dim=-1),
            torch.stack(aside, dim=-1),
            length_m,
            present,
            size_lw_m[:, 1] / 2,
        )

    def part(self, rows: slice) -> "EdgesNear":
        """Take some rows."""
        return EdgesNear(
            self.told[rows],
            self.aside[rows],
            self.length_m[rows],
            self.present[rows],
            self.half_width_m[rows],
        )

    def over_m(
        self, points: Float32[Tensor, "#row 5 place"]
    ) -> Float32[Tensor, "row place"]:
        """How far boxes at places would be over the nearest edge; negative on the road."""
        if not self.present.shape[1]:
            rows, places = len(self.present), points.shape[-1]
            return points.new_full((rows, places), -torch.inf)
        along_m, aside_m = self.told @ points, self.aside @ points  # [n, E, place]
        beyond_m = along_m - along_m.clamp(min=0).minimum(self.length_m[..., None])
        side_m2 = aside_m * aside_m
        away_m2 = beyond_m * beyond_m + side_m2
        rank = torch.where(
            self.present[..., None], away_m2 - ALONG_ITS_SIDE * side_m2, torch.inf
        )
        # Where an edge is the nearest one, else nothing: faster than to look for its place.
        is_nearest = rank <= rank.amin(dim=1, keepdim=True)
        over_m2 = away_m2.copysign(-aside_m)
        over_m2 = torch.where(is_nearest, over_m2, -torch.inf).amax(dim=1)
        over_m = over_m2.abs().sqrt().copysign(over_m2) + self.half_width_m[:, None]
        return torch.where(self.present.any(dim=1, keepdim=True), over_m, -torch.inf)


class EdgeClearance(AnchorHead):
    """How agents judge motion tokens by how far they lead over road edges."""

    points: Tensor
    now: Tensor
    knot_m: Tensor

    def __init__(self, width: int, head_width: int, vocabulary: MotionVocabulary) -> None:
        anchors = Anchors.of(vocabulary)
        features = (len(KNOTS_M) - 1) * (len(POINTS) + 2)
        super().__init__(width, head_width, features, anchors)
        for name, array in (
            ("points", _points(anchors)),
            ("now", NOW),
            ("knot_m", KNOTS_M),
        ):
            buffer = torch.from_numpy(np.asarray(array, dtype=np.float32))
            self.register_buffer(name, buffer, persistent=False)

    def forward(
        self, x_ND: Tensor, agent_type: Int64[Tensor, " row"], edges: EdgesNear
    ) -> Tensor:
        """Judge the anchors of agents: what is added to their logits [N, R].

        Args:
            x_ND: Features of the agents.
            agent_type: ``AgentType`` of each.
            edges: Edges near each.
        """
        return self.judge(x_ND, self.features(agent_type, edges))

    @torch.no_grad()
    def features(
        self, agent_type: Int64[Tensor, " row"], edges: EdgesNear
    ) -> Float32[Tensor, "row anchor feature"]:
        """Describe how far boxes would be over edges, and how far they are now."""
        with full_precision(edges.told):
            parts = [
                self._features(agent_type[part], edges.part(part))
                for part in row_parts(agent_type)
            ]
        none = edges.told.new_zeros((0, self.anchors, self.gaps.in_features))
        return torch.cat([none, *parts])

    def _features(self, agent_type: Tensor, edges: EdgesNear) -> Tensor:
        """The same of some rows."""
        over_m = edges.over_m(self.points[agent_type])
        over_m = over_m.view(len(over_m), len(POINTS), self.anchors).mT  # [n, R, point]
        now_m = edges.over_m(self.now)[:, None].expand(-1, self.anchors, -1)
        over_m = torch.cat([over_m, now_m], dim=-1)[..., None]
        low, high = self.knot_m[:-1], self.knot_m[1:]
        return ((over_m - low) / (high - low)).clamp(0, 1).flatten(2)


def _points(anchors: Anchors) -> Float32[np.ndarray, "3 5 points_anchors"]:
    """What edges near are multiplied by: places of fronts and rears."""
    cos, sin = anchors.direction()
    found = []
    for time_s, side in POINTS:
        x_m, y_m = np.moveaxis(anchors.place_m(time_s), -1, 0)
        found.append(
            np.stack([x_m, y_m, side * cos, side * sin, -np.ones_like(x_m)], axis=1)
        )
    return np.concatenate(found, axis=-1).astype(np.float32)
