"""What lies where inserted agents may enter: features of cells themselves.

The paper's head chooses among two thousand cells from one feature of the query, which
would have to carry the whole street (SPEC 4.6). Here what is around is laid onto the cells
that it covers, and each of them has a say of its own.

Everything is shared out between the nearest points of a lattice, in float32 also under
autocast, so features change continuously with poses. Shape letters as in ``layers``; C is
the width of these features.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.insertion.cell_refinement import CellRefinement, lattice_centres_m
from infgen.model.layers import AttentionSources, embedding_mlp, gather
from infgen.model.neighbours import MapFeatures, grid_place
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import NO_CELL

ROAD_MIDDLE_M = 2.5
"""From the first point of a map token to about its middle."""


@dataclass(frozen=True, slots=True)
class CellSources:
    """Things around queries: roads or agents.

    Attributes:
        features: Features of all things [M, D].
        row: Row of each query's things among them [N, K].
        pose: Their poses [N, K, 3].
        present: Which of them there are [N, K].
    """

    features: Tensor
    row: Tensor
    pose: Tensor
    present: Tensor

    @classmethod
    def roads(cls, roads: MapFeatures, scene: Tensor) -> "CellSources":
        """All map tokens of the maps [N] of queries, at about their middles."""
        pose = roads.pose
        along = torch.stack([pose[..., 2].cos(), pose[..., 2].sin()], dim=-1)
        middle_m = pose[..., :2] + ROAD_MIDDLE_M * along
        pose = torch.cat([middle_m, pose[..., 2:]], dim=-1)
        return cls(roads.features, roads.rows.number[scene], pose[scene], roads.real[scene])

    @classmethod
    def near(cls, roads: MapFeatures, seen: AttentionSources) -> "CellSources":
        """The map tokens that queries [N] see, at their first points."""
        pose = roads.rows.pack(roads.pose)
        return cls(roads.features, seen.index, pose[seen.index], seen.present)


class CellFeatures(nn.Module):
    """Features of every cell of an ego's grid, from what lies on it and beside it."""

    lattice: Tensor
    centre_m: Tensor

    def __init__(
        self, width: int, cell_feature_width: int, refinement_width: int, grid: Grid
    ) -> None:
        super().__init__()
        self.width = cell_feature_width
        self.step_m = grid.step_m
        self.side = len(grid.cell_at)
        inside = np.flatnonzero(grid.cell_at != NO_CELL)
        lattice = np.empty(grid.num_cells, dtype=np.int64)
        lattice[grid.cell_at.flat[inside]] = inside
        self.register_buffer("lattice", torch.from_numpy(lattice), persistent=False)
        centre_m = torch.from_numpy(grid.centre_m.copy())
        self.register_buffer("centre_m", centre_m, persistent=False)
        self.road = nn.Linear(width, cell_feature_width)
        self.agent = nn.Linear(width, cell_feature_width)
        self.turned = nn.Linear(2, cell_feature_width, bias=False)
        self.place = embedding_mlp(2, cell_feature_width)
        self.beside = nn.Conv2d(
            cell_feature_width, cell_feature_width, 3, padding=1, bias=False
        )
        self.key = nn.Linear(cell_feature_width, cell_feature_width)
        self.ask = nn.Linear(width, cell_feature_width)
        centres_m = lattice_centres_m(self.side, self.step_m)
        self.refinement = (
            CellRefinement(width, cell_feature_width, refinement_width, centres_m)
            if refinement_width
            else None
        )

    def forward(self, ego_pose: Tensor, roads: CellSources, agents: CellSources) -> Tensor:
        """Describe the cells around egos [N, 3]: features [N, cell, C].

        With a refinement, its features follow [N, cell, 2 C].
        """
        laid = self._cell_sources(ego_pose, roads, self.road) + self._cell_sources(
            ego_pose, agents, self.agent
        )
        square = laid.view(len(ego_pose), self.side, self.side, laid.shape[1])
        square = square.permute(0, 3, 1, 2)
        cells = self.beside(square).flatten(2)[..., self.lattice].mT
        keys: Tensor = self.key(functional.relu(cells + self.place(self.centre_m)))
        if self.refinement is None:
            return keys
        return torch.cat([keys, self.refinement(square, self.lattice)], dim=-1)

    def choose(self, x_NSD: Tensor, cells_NPC: Tensor) -> Tensor:
        """Say how much queries are for each cell: logits [N, S, cell]."""
        asked = self.ask(x_NSD) * self.width**-0.5
        logits: Tensor = asked @ cells_NPC[..., : self.width].mT
        return logits

    def refine(self, x_NSD: Tensor, cells_NPC: Tensor) -> Tensor | None:
        """Say what a refinement adds to these logits; None without one."""
        if self.refinement is None:
            return None
        return self.refinement.choose(x_NSD, cells_NPC[..., self.width :])

    def _cell_sources(
        self, ego_pose: Tensor, lying: CellSources, project: nn.Linear
    ) -> Tensor:
        """Share things out between the four lattice points around each: [point, C]."""
        last = self.side - 1
        xy_m = grid_place(lying.pose, ego_pose[:, None])
        at = xy_m / self.step_m + last / 2  # column, row
        inside = lying.present & (at > 0).all(dim=-1) & (at < last).all(dim=-1)
        query, thing, counts = chosen(inside)
        at = at[query, thing]
        turned_rad = lying.pose[query, thing, 2] - ego_pose[query, 2]
        features = gather(project(lying.features), lying.row[query, thing])
        features = functional.relu(features + self.turned(unit(turned_rad)))
        if counts is not None:
            features, at = features * counts, at.clamp(0, last)

        lower = at.floor().clamp(max=last - 1)
        share = at - lower
        token_step, row = lower.long().unbind(-1)
        first = (query * self.side + row) * self.side + token_step
        laid = share.new_zeros((len(ego_pose) * self.side**2, features.shape[1]))
        for up in (0, 1):
            for right in (0, 1):
                weight = _part(share[:, 0], right) * _part(share[:, 1], up)
                point = first + up * self.side + right
                laid = laid.index_add(0, point, features * weight[:, None])
        return laid


def chosen(inside: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Indices of the true places of a mask, and what they count for; None for all alike.

    Only a CPU looks which they are: elsewhere the host would wait, so there all places are
    taken, and those that are false count nothing.
    """
    if inside.device.type == "cpu":
        query, thing = inside.nonzero(as_tuple=True)
        return query, thing, None
    things = inside.shape[1]
    place = torch.arange(inside.numel(), device=inside.device)
    counts = inside.flatten()[:, None].to(torch.float32)
    return place // things, place % things, counts


def unit(angle_rad: Tensor) -> Tensor:
    """Unit vectors at angles [...]: [..., 2]."""
    return torch.stack([angle_rad.cos(), angle_rad.sin()], dim=-1)


def _part(share: Tensor, upper: int) -> Tensor:
    return share if upper else 1 - share
