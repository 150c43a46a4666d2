"""Features of headings and of offset bins themselves, from the map tokens around a query.

As with cells (``cell_features``), each has a say of its own. Shape letters as in
``layers``; C is the width of these features.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.insertion.cell_features import ROAD_MIDDLE_M, CellSources, unit
from infgen.model.layers import begin_last_at_zero, full_precision, gather, mlp
from infgen.model.neighbours import grid_place
from infgen.model.relations import wrap_angle
from infgen.tokens.grid import Grid

BIN_REACH = 2
"""Bins to each side that what lies in a bin speaks to."""
LATERAL_REACH_M = 4.0
LATERAL_STEP_M = 0.25
"""Lateral offsets from a map token are told apart so finely, so far on either side."""
LAST_SHARE = 1e-4
"""Of a step: so far from the last lateral offset, one further is always there."""


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
        along = unit(turned_rad)
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
        # A product, so of low precision under autocast.
        said = between_knots(profile.float(), at)
        beside = (2 - (along_m / ROAD_MIDDLE_M - 1).abs()).clamp(0, 1)
        return (said * beside * roads.present[..., None]).sum(dim=1)


def _ring(values: Tensor) -> Tensor:
    """Continue bins around the full turn, as far as a convolution reaches."""
    return functional.pad(values, (BIN_REACH, BIN_REACH), mode="circular")


def between_knots(said: Tensor, at: Tensor) -> Tensor:
    """Interpolate what knots [..., knot] say at places [..., place], in knots from 0 on."""
    at = at.clamp(0, said.shape[-1] - 1 - LAST_SHARE)
    lower = at.floor()
    share, lower = at - lower, lower.long()
    return torch.lerp(said.gather(-1, lower), said.gather(-1, lower + 1), share)
