"""The map as features: encoded once per scene, and predicted piece by piece."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from infgen.model.batching.batch import MapTokens
from infgen.model.device.index import MapIndex
from infgen.model.features.polyline_segments import lane_centres, road_edges
from infgen.model.features.signals import StopLines
from infgen.model.layers import Attention, embedding_mlp, gather, mlp, normed
from infgen.model.map_grid import MapGrid
from infgen.model.neighbours import MapFeatures, NeighbourRows, NeighbourSpec, SignalStates
from infgen.model.relations import Rows, relation_embedding, turn_of_rows
from infgen.model.rotary.turns import turned
from infgen.model.settings import ModelSettings
from infgen.tokens.map import PointType, PolylineType
from infgen.tokens.scene_tokens import SignalClass
from infgen.tokens.signals import REMEMBERED
from infgen.tokens.vocabulary import MapVocabulary


@dataclass(frozen=True, slots=True)
class MapContext:
    """Neighbours of map tokens.

    Attributes:
        rows: The map tokens.
        neighbours: Those of each.
        grid: The map tokens by where they are.
        index: All places of the maps, if they are known already.
    """

    rows: Rows
    neighbours: NeighbourRows
    grid: MapGrid
    index: MapIndex | None = None

    def covered(self, roads: MapTokens) -> "MapContext":
        """Exclude hidden tokens as sources: their positions would reveal them."""
        kept = ~self.rows.pack(roads.picked)
        present = self.neighbours.present & kept[self.neighbours.index]
        return replace(self, neighbours=replace(self.neighbours, present=present))


class MapEncoder(nn.Module):
    """Embed map tokens and let them see their neighbours (SPEC 4.3)."""

    curve_m: Tensor

    def __init__(self, settings: ModelSettings, vocabulary: MapVocabulary) -> None:
        super().__init__()
        width = settings.width
        self.radius_m = settings.map_map_radius_m
        self.signals_each_step = settings.signals_each_step
        self.stop_lines = settings.signal_ahead_m > 0
        by_edges = settings.over_edge_head or settings.placement_features
        self.edges = settings.edge_clearance_width > 0 or by_edges
        self.lanes = settings.placement_features
        self.neighbours = settings.map_map_neighbours
        curve_m = torch.from_numpy(vocabulary.curve_m.copy())
        self.register_buffer("curve_m", curve_m, persistent=False)
        self.curve = embedding_mlp(vocabulary.curve_m[0].size, width)
        self.point_kind = nn.Embedding(len(PointType), width)
        self.line_kind = nn.Embedding(len(PolylineType), width)
        looks = len(SignalClass) + (REMEMBERED if self.signals_each_step else 0)
        self.signal = nn.Embedding(looks, width)
        self.relation = relation_embedding(self.radius_m, settings)
        self.blocks = nn.ModuleList(
            Attention(settings, bipartite=False) for _ in range(settings.map_blocks)
        )
        self.next_token = mlp(width, width, vocabulary.num_map_tokens)

    def look(self, roads: MapTokens, index: MapIndex | None = None) -> MapContext:
        """Find the neighbours of all map tokens; ``index`` if it is known already."""
        if index is None:
            rows, grid = Rows.where(roads.real), MapGrid.of(roads.pose, roads.real)
        else:
            rows, grid = index.rows, index.grid
        reach = NeighbourSpec.of(self.radius_m, self.neighbours, self.relation)
        pose, count = rows.pack(roads.pose), roads.real.shape[1]
        scene = rows.at // max(1, count)
        found = grid.nearest(
            pose[:, :2], scene, reach.radius_m, reach.count, itself=rows.at % max(1, count)
        )
        place, present = found.index[0], found.present[0]
        neighbours = NeighbourRows(
            index=rows.number[scene[:, None], place],
            relation=reach.describe(pose, roads.pose[scene[:, None], place]),
            present=present,
            place=place,
            turn=self.relation.turn(pose),
        )
        return MapContext(rows, neighbours, grid, index)

    def forward(self, roads: MapTokens, sight: MapContext) -> MapFeatures:
        """Encode every map token."""
        x = self.encode(roads, sight)
        return self.lay_out(roads, sight.rows, sight.grid, x, sight.index)

    def encode(self, roads: MapTokens, sight: MapContext) -> Tensor:
        """Return what every map token is among its neighbours [row, D]."""
        x = self._embed(roads, sight.rows)
        for block in self.blocks:
            shown = turned(normed(x), sight.neighbours.turn)
            x = block(x, sight.neighbours.seen(shown))
        return x

    def lay_out(
        self,
        roads: MapTokens,
        rows: Rows,
        grid: MapGrid,
        x: Tensor,
        index: MapIndex | None = None,
    ) -> MapFeatures:
        """Put encoded map tokens side by side, to be looked up; no network is evaluated.

        Args:
            roads: The maps.
            rows: Their map tokens.
            grid: The same by where they are.
            x: What ``encode`` said of them, map after map.
            index: Places among them, if they are known already.
        """
        features, signal_states = normed(x), None
        turn = turn_of_rows(self.relation, rows, roads.pose)
        if self.signals_each_step:
            lit = rows.pack(roads.light).nonzero()[:, 0] if index is None else index.lit
            looks = normed(x[lit, None] + self.signal.weight)  # [lit, class, D]
            features = torch.cat([features, looks.flatten(0, 1)])
            signal_states = _signal_states(roads, len(x), lit, looks.shape[1])
            if turn is not None:
                turn = torch.cat([turn, turn[lit].repeat_interleave(looks.shape[1], dim=0)])
        lines = None
        if self.stop_lines:
            lines = StopLines.of(roads) if index is None else index.lines
        edges = lanes = None
        if self.edges:
            edges = road_edges(roads) if index is None else index.edges
        if self.lanes:
            lanes = lane_centres(roads) if index is None else index.lanes
        return MapFeatures(
            rows,
            features,
            turned(features, turn),
            roads.pose,
            roads.real,
            grid,
            signal_states,
            lines,
            edges,
            lanes,
        )

    def predict_hidden(
        self, roads: MapTokens, covered: MapFeatures, index: MapIndex | None = None
    ) -> tuple[Tensor, Tensor]:
        """Predict hidden map tokens from their predecessors, which did not see them.

        A token is predicted if it is hidden and its predecessor is not.

        Args:
            roads: The maps.
            covered: Features of a pass in which hidden tokens were not seen.
            index: Their places, if they are known already.

        Returns:
            Logits [prediction, token] and the true tokens [prediction].
        """
        if index is not None:
            logits = self.next_token(gather(covered.features, index.before))
            return logits, roads.token.flatten()[index.hidden]
        wanted = roads.predicted
        before = covered.rows.number.roll(1, dims=1)[wanted]
        return self.next_token(covered.features[before]), roads.token[wanted]

    def _embed(self, roads: MapTokens, rows: Rows) -> Tensor:
        """What each map token is, by itself [row, D]."""
        shapes = self.curve(self.curve_m.flatten(1))  # [token, D]
        embedded: Tensor = gather(shapes, rows.pack(roads.token))
        embedded = embedded + self.point_kind(rows.pack(roads.point_type))
        embedded = embedded + self.line_kind(rows.pack(roads.polyline_type))
        if self.signals_each_step:
            return embedded
        return embedded + self.signal(rows.pack(roads.signal))


def _signal_states(roads: MapTokens, rows: int, lit: Tensor, classes: int) -> SignalStates:
    """Say where the looks of map tokens with a light [lit] are: behind all rows."""
    first = torch.zeros(rows, dtype=torch.int64, device=lit.device)
    first[lit] = rows + torch.arange(len(lit), device=lit.device) * classes
    return SignalStates(first, roads.light, roads.shown)
