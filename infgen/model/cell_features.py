"""What lies where inserted agents may enter: features of cells and of headings themselves.

The paper's heads choose among two thousand cells and 120 headings from one feature of the
query, which would have to carry the whole street (SPEC 4.6). Here what is around is laid
onto the cells, or the bins, that it covers, and each of them has a say of its own.

Everything is shared out between the nearest points of a lattice, in float32 also under
autocast, so features change continuously with poses. Shape letters as in ``layers``; C is
the width of these features.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.cell_refinement import CellRefinement, lattice_centres_m
from infgen.model.layers import (
    AttentionSources,
    begin_last_at_zero,
    embedding_mlp,
    full_precision,
    gather,
    mlp,
)
from infgen.model.neighbours import MapFeatures, grid_place
from infgen.model.relations import wrap_angle
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import NO_CELL

ROAD_MIDDLE_M = 2.5
"""From the first point of a map token to about its middle."""
BIN_REACH = 2
"""Bins to each side that what lies in a bin speaks to."""
LATERAL_REACH_M = 4.0
LATERAL_STEP_M = 0.25
"""Lateral offsets from a map token are told apart so finely, so far on either side."""
LAST_SHARE = 1e-4
"""Of a step: so far from the last lateral offset, one further is always there."""


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
        query, thing, counts = _chosen(inside)
        at = at[query, thing]
        turned_rad = lying.pose[query, thing, 2] - ego_pose[query, 2]
        features = gather(project(lying.features), lying.row[query, thing])
        features = functional.relu(features + self.turned(_unit(turned_rad)))
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


class HeadingFeatures(nn.Module):
    """Logits of headings, from the headings of the roads around a query."""

    def __init__(self, width: int, cell_feature_width: int, num_headings: int) -> None:
        super().__init__()
        self.num_headings = num_headings
        self.road = nn.Linear(width, cell_feature_width)
        self.apart = nn.Linear(2, cell_feature_width)
        self.asked = nn.Linear(width, cell_feature_width)
        size = 2 * BIN_REACH + 1
        self.beside = nn.Conv1d(cell_feature_width, cell_feature_width, size, bias=False)
        self.say = nn.Conv1d(cell_feature_width, 1, size, bias=False)

    def forward(
        self, x: Tensor, pose: Tensor, roads: CellSources, offset_m: Tensor | None = None
    ) -> Tensor:
        """Say how much queries [N, ..., D] at poses [N, 3] are for each heading.

        With ``offset_m`` [N, 2] they are that far from these poses, in their grid frames.
        """
        queries = x.flatten(1, -2) if x.dim() > 2 else x[:, None]  # [N, S, D]
        place_m = grid_place(roads.pose, pose[:, None])
        if offset_m is not None:
            place_m = place_m - offset_m[:, None]
        road = gather(self.road(roads.features), roads.row)
        road = road + self.apart(place_m / ROAD_MIDDLE_M)
        features = functional.relu(road[:, None] + self.asked(queries)[:, :, None])
        features = features * roads.present[:, None, :, None]  # [N, S, K, C]
        turned_rad = wrap_angle(roads.pose[..., 2] - pose[:, None, 2])
        bins = self._shares(turned_rad)  # [N, K, heading]
        with full_precision(x):
            laid = torch.einsum("nskc,nkh->nsch", features.float(), bins).flatten(0, 1)
        logits = self.say(_ring(functional.relu(self.beside(_ring(laid)))))
        return logits.view(*x.shape[:-1], self.num_headings)

    def _shares(self, turned_rad: Tensor) -> Tensor:
        """Share angles out between the middles of the two nearest bins: [..., heading]."""
        count = self.num_headings
        at = (turned_rad + math.pi) / (2 * math.pi) * count - 0.5
        lower = at.floor()
        share = at - lower
        bins = torch.arange(count, device=at.device)
        first = lower.long() % count
        second = (first + 1) % count
        return (first[..., None] == bins) * (1 - share[..., None]) + (
            second[..., None] == bins
        ) * share[..., None]


class OffsetEmbedding(nn.Module):
    """Embedding of the offset bin of an agent, for what is given it."""

    offset_m: Tensor

    def __init__(self, width: int, grid: Grid) -> None:
        super().__init__()
        offset_m = torch.from_numpy(grid.offset_m.copy())
        self.register_buffer("offset_m", offset_m, persistent=False)
        self.embed = nn.Embedding(len(offset_m), width)

    def begin_at_zero(self) -> None:
        """Change nothing until it is trained."""
        nn.init.zeros_(self.embed.weight)

    def forward(self, offset: Tensor) -> Tensor:
        """Embed offset bins [N]: [N, D]."""
        embedded: Tensor = self.embed(offset)
        return embedded


class OffsetFeatures(nn.Module):
    """Logits of the offset bins of a cell, given the agent type.

    Each map token around has a say by how far a bin is to its side: the middle of a lane,
    the road edge. What it says depends on the token and on the query.
    """

    offset_m: Tensor

    def __init__(self, width: int, cell_feature_width: int, grid: Grid) -> None:
        super().__init__()
        offset_m = torch.from_numpy(grid.offset_m.copy())
        self.register_buffer("offset_m", offset_m, persistent=False)
        self.alone = mlp(width, width, len(offset_m))
        self.steps = round(2 * LATERAL_REACH_M / LATERAL_STEP_M)
        features = cell_feature_width
        self.road = nn.Linear(width, features) if features else None
        self.turned = nn.Linear(2, features, bias=False) if features else None
        self.asked = nn.Linear(width, features) if features else None
        self.lateral = nn.Embedding(self.steps + 1, features) if features else None
        self.say = nn.Linear(features, 1, bias=False) if features else None

    def begin_at_zero(self) -> None:
        """Take all bins for equally likely until they are trained."""
        begin_last_at_zero(self.alone)
        if self.say is not None:
            nn.init.zeros_(self.say.weight)

    def forward(self, x: Tensor, pose: Tensor, roads: CellSources) -> Tensor:
        """Say how much queries [N, D] at poses [N, 3] are for each bin [N, offset].

        Args:
            x: Features of the queries, given the agent type.
            pose: Poses of the queries: at the centre of the cell, facing as the ego.
            roads: Map tokens that the queries see.
        """
        logits: Tensor = self.alone(x)
        if self.road is None:
            return logits
        assert self.turned is not None
        assert self.asked is not None
        assert self.lateral is not None
        assert self.say is not None
        turned_rad = roads.pose[..., 2] - pose[:, None, 2]
        along = _unit(turned_rad)
        features = gather(self.road(roads.features), roads.row) + self.turned(along)
        features = features + self.asked(x)[:, None]  # [N, K, C]
        said = functional.relu(features[:, :, None] + self.lateral.weight)
        profile = self.say(said)[..., 0]  # [N, K, lateral]
        return logits + self._along(profile, along, pose, roads)

    def _along(
        self, profile: Tensor, along: Tensor, pose: Tensor, roads: CellSources
    ) -> Tensor:
        """Add up what the map tokens say of the bins beside them [N, offset].

        ``along`` is their direction, from where the query faces [N, K, 2].
        """
        first_m = grid_place(roads.pose, pose[:, None])
        away_m = self.offset_m - first_m[:, :, None]  # [N, K, offset, 2]
        cos, sin = along[..., None].unbind(-2)
        x_m, y_m = away_m.unbind(-1)
        along_m, left_m = cos * y_m - sin * x_m, -cos * x_m - sin * y_m
        at = (left_m + LATERAL_REACH_M) / LATERAL_STEP_M
        at = at.clamp(0, self.steps - LAST_SHARE)
        lower = at.floor()
        share, lower = at - lower, lower.long()
        profile = profile.float()  # A product, so of low precision under autocast.
        said = torch.lerp(profile.gather(2, lower), profile.gather(2, lower + 1), share)
        beside = (2 - (along_m / ROAD_MIDDLE_M - 1).abs()).clamp(0, 1)
        return (said * beside * roads.present[..., None]).sum(dim=1)


def _chosen(inside: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
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


def _unit(angle_rad: Tensor) -> Tensor:
    return torch.stack([angle_rad.cos(), angle_rad.sin()], dim=-1)


def _part(share: Tensor, upper: int) -> Tensor:
    return share if upper else 1 - share


def _ring(values: Tensor) -> Tensor:
    """Continue bins around the full turn, as far as a convolution reaches."""
    return functional.pad(values, (BIN_REACH, BIN_REACH), mode="circular")
