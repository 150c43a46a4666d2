"""The map as features: encoded once per scene, and predicted piece by piece."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from infgen.config import ModelSettings
from infgen.model.batch import Roads
from infgen.model.layers import Attention, Seen, embedding_mlp, gather, mlp, normed
from infgen.model.relations import Neighbours, Rows, nearest, relation_embedding, relations
from infgen.tokens.codebook import RoadCodebook
from infgen.tokens.roads import LineKind, PointKind
from infgen.tokens.scene_tokens import SignalClass


@dataclass(frozen=True, slots=True)
class RoadFeatures:
    """Encoded maps, one after the other.

    Attributes:
        rows: Which places of the padded maps they are.
        features: Normed features [row, D].
        pose: Poses of the padded maps [scene, road, 3].
        real: Which places of the padded maps hold a road token [scene, road].
    """

    rows: Rows
    features: Tensor
    pose: Tensor
    real: Tensor


class RoadEncoder(nn.Module):
    """Embed road tokens and let them see their neighbours (SPEC 4.3)."""

    curve_m: Tensor

    def __init__(self, settings: ModelSettings, codebook: RoadCodebook) -> None:
        super().__init__()
        width = settings.width
        self.radius_m = settings.map_map_radius_m
        self.neighbours = settings.map_map_neighbours
        curve_m = torch.from_numpy(codebook.curve_m.copy())
        self.register_buffer("curve_m", curve_m, persistent=False)
        self.curve = embedding_mlp(codebook.curve_m[0].size, width)
        self.point_kind = nn.Embedding(len(PointKind), width)
        self.line_kind = nn.Embedding(len(LineKind), width)
        self.signal = nn.Embedding(len(SignalClass), width)
        self.relation = relation_embedding(self.radius_m, settings.fourier_bands, width)
        self.blocks = nn.ModuleList(
            Attention(width, settings.heads, settings.dropout, bipartite=False)
            for _ in range(settings.map_blocks)
        )
        self.next_token = mlp(width, width, codebook.num_roads)

    def forward(self, roads: Roads) -> RoadFeatures:
        """Encode every road token."""
        rows = Rows.where(roads.real)
        found = self._nearest(roads, roads.real)
        encoded = normed(self._encode(roads, rows, found))
        return RoadFeatures(rows, encoded, roads.pose, roads.real)

    def predict_hidden(self, roads: Roads) -> tuple[Tensor, Tensor]:
        """Predict hidden road tokens from their predecessors, which cannot see them.

        A token is predicted if it is hidden and its predecessor is not. The hidden ones are
        taken off the map altogether: in its relations a place alone would give them away.

        Returns:
            Logits [prediction, token] and the true tokens [prediction].
        """
        kept = roads.real & ~roads.picked
        wanted = roads.real & roads.picked & roads.follows
        wanted[:, 1:] &= kept[:, :-1]
        rows = Rows.where(kept)
        encoded = self._encode(roads, rows, self._nearest(roads, kept))
        before = rows.number.roll(1, dims=1)[wanted]
        return self.next_token(encoded[before]), roads.token[wanted]

    def _nearest(self, roads: Roads, real: Tensor) -> Neighbours:
        """Find the neighbours of each road token, itself left out."""
        count = real.shape[1]
        others = ~torch.eye(count, dtype=torch.bool, device=real.device)
        xy_m = roads.pose[..., :2]
        allowed = real[:, None] & others
        return nearest(xy_m, xy_m, allowed, self.radius_m, self.neighbours)

    def _encode(self, roads: Roads, rows: Rows, found: Neighbours) -> Tensor:
        """Features [row, D] of the road tokens that are rows."""
        scene = torch.arange(len(roads.real), device=roads.real.device)
        index = rows.pack(rows.number[scene[:, None, None], found.index])  # [row, K]
        pose = rows.pack(roads.pose)
        related = self.relation.look_up(relations(pose, pose[index]), self.relation.table())
        present = rows.pack(found.present)

        x = self._embed(roads, rows)
        for block in self.blocks:
            x = block(x, Seen(gather(normed(x), index), related, present))
        return x

    def _embed(self, roads: Roads, rows: Rows) -> Tensor:
        """What each road token is, by itself [row, D]."""
        shapes = self.curve(self.curve_m.flatten(1))  # [token, D]
        embedded: Tensor = gather(shapes, rows.pack(roads.token))
        embedded = embedded + self.point_kind(rows.pack(roads.point_kind))
        embedded = embedded + self.line_kind(rows.pack(roads.line_kind))
        return embedded + self.signal(rows.pack(roads.signal))
