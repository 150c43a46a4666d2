"""Polylines of one type in straight segments: road edges, lanes.

Each map token is one segment, from where it begins to where the next one of its polyline
does.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional

from infgen.model.batching.batch import MapTokens
from infgen.model.map_grid import MapGrid
from infgen.tokens.map import PolylineType
from infgen.tokens.vocabulary import MAP_SPACING_M

LENGTH_M = 10 * MAP_SPACING_M
"""Of a segment that nothing follows."""


@dataclass(frozen=True, slots=True)
class PolylineSegments:
    """Straight segments of maps; of road edges, with the road on their left.

    Attributes:
        start_m: Where they begin; padding is anywhere [scene, segment, 2].
        along_m: From there to where they end [scene, segment, 2].
        grid: The same by where their middles are.
    """

    start_m: Float32[Tensor, "scene segment 2"]
    along_m: Float32[Tensor, "scene segment 2"]
    grid: MapGrid

    @classmethod
    def of(cls, roads: MapTokens, polyline_type: PolylineType) -> "PolylineSegments":
        """Find those of one type of polyline; each ends where the next one begins."""
        chosen = roads.real & (roads.polyline_type == int(polyline_type))
        count = int(chosen.sum(dim=1).max()) if chosen.numel() else 0
        at = chosen.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, :count]
        start_m, heading_rad = roads.pose[..., :2], roads.pose[..., 2]
        straight_m = LENGTH_M * torch.stack([heading_rad.cos(), heading_rad.sin()], dim=-1)
        goes_on = roads.follows.roll(-1, dims=1) & chosen.roll(-1, dims=1)
        goes_on[:, -1:] = False
        to_next_m = start_m.roll(-1, dims=1) - start_m
        along_m = torch.where(goes_on[..., None], to_next_m, straight_m)

        def taken(values: Tensor) -> Tensor:
            return values.gather(1, at[..., None].expand(-1, -1, values.shape[-1]))

        start_m, along_m = taken(start_m), taken(along_m)
        middle = functional.pad(start_m + along_m / 2, (0, 1))
        return cls(start_m, along_m, MapGrid.of(middle, chosen.gather(1, at)))


def road_edges(roads: MapTokens) -> PolylineSegments:
    """Find the road edges of maps."""
    return PolylineSegments.of(roads, PolylineType.ROAD_EDGE)


def lane_centres(roads: MapTokens) -> PolylineSegments:
    """Find the lanes of maps."""
    return PolylineSegments.of(roads, PolylineType.LANE)
