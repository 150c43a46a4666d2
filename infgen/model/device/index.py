"""Which places of a padded batch hold something: found on the host, before it is moved.

A GPU that is asked for the true places of a mask makes the host wait until it has done all
that was asked of it before. All masks here follow from a batch alone, so loaders find their
places and send them along.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from infgen.model.batching.batch import Batch, MapTokens
from infgen.model.features.polyline_segments import (
    PolylineSegments,
    lane_centres,
    road_edges,
)
from infgen.model.features.signals import StopLines
from infgen.model.map_grid import MapGrid
from infgen.model.relations import Rows

MOST_SQUARES = 40
"""Searches of the map cross no more of its squares in a row: circles of 190 m."""


@dataclass(frozen=True, slots=True)
class MapIndex:
    """Places of maps.

    Attributes:
        rows: Map tokens among [scene, road].
        grid: The same by where they are.
        hidden: Flat places of the map tokens that are predicted ...
        before: ... and the row of the one before each.
        lit: Rows of the map tokens with a traffic light.
        lines: Stop lines.
        edges: Road edges.
        lanes: Lanes.
    """

    rows: Rows
    grid: MapGrid
    hidden: Int64[Tensor, " prediction"]
    before: Int64[Tensor, " prediction"]
    lit: Int64[Tensor, " lit"]
    lines: StopLines
    edges: PolylineSegments
    lanes: PolylineSegments

    @classmethod
    def of(cls, roads: MapTokens) -> "MapIndex":
        """Find the places of some maps."""
        rows, grid = Rows.where(roads.real), MapGrid.of(roads.pose, roads.real)
        edges = road_edges(roads)
        lanes = lane_centres(roads)
        for each in (grid, edges.grid, lanes.grid):
            each.measure(MOST_SQUARES)
        wanted = roads.predicted
        before = rows.number.roll(1, dims=1)
        return cls(
            rows=rows,
            grid=grid,
            hidden=wanted.flatten().nonzero()[:, 0],
            before=before[wanted],
            lit=rows.pack(roads.light).nonzero()[:, 0],
            lines=StopLines.of(roads),
            edges=edges,
            lanes=lanes,
        )


@dataclass(frozen=True, slots=True)
class BatchIndex:
    """Places of a batch.

    Attributes:
        visible: Agents among [scene, token, agent].
        asked: Tokens with an insertion query among [scene, token].
        described: Agents described among [scene, detail].
        roads: Those of the maps.
    """

    visible: Rows
    asked: Rows
    described: Rows
    roads: MapIndex

    @classmethod
    @torch.no_grad()
    def of(cls, batch: Batch) -> "BatchIndex":
        """Find the places of a batch."""
        return cls(
            visible=Rows.where(batch.agents.visible),
            asked=Rows.where(batch.entries.asked),
            described=Rows.where(batch.details.present),
            roads=MapIndex.of(batch.roads),
        )
