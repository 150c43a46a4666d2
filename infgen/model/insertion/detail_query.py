"""Detail query: type, size, heading and offset of an inserted agent at a cell.

Shape letters as in ``layers``.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from infgen.model.agent_embedding import KINDS
from infgen.model.insertion.agent_spacing import OffsetSpacing, SpacedAgents
from infgen.model.insertion.cell_features import CellSources
from infgen.model.insertion.detail_features import (
    HeadingFeatures,
    OffsetEmbedding,
    OffsetFeatures,
)
from infgen.model.insertion.placement_features import PlacementFeatures, Places
from infgen.model.insertion.query_block import QueryBlock
from infgen.model.layers import AttentionSources, embedding_mlp, full_precision, mlp
from infgen.model.logits import DetailOutputs
from infgen.model.neighbours import NeighbourSpec
from infgen.model.relations import Rows, relation_embedding
from infgen.model.settings import ModelSettings
from infgen.tokens.grid import Grid

OFFSET_REACH_STEPS = 2 / 3
"""Offsets lie within so many grid steps of a cell's centre (2 m for 3 m cells)."""


class DetailStack(nn.Module):
    """Detail query from the centre of a cell: type, size, heading and offset (SPEC 4.7).

    Where positions are regressed, the query stands at the position itself.
    """

    centre_m: Tensor

    def __init__(self, settings: ModelSettings, grid: Grid) -> None:
        super().__init__()
        width = settings.width
        self.settings = settings
        self.reach_m = OFFSET_REACH_STEPS * grid.step_m
        centre_m = torch.from_numpy(grid.centre_m.copy())
        self.register_buffer("centre_m", centre_m, persistent=False)
        self.query = nn.Embedding(1, width)
        self.cells = embedding_mlp(2, width)
        self.roads_relation = relation_embedding(settings.heading_query_radius_m, settings)
        self.agents_relation = relation_embedding(settings.heading_query_radius_m, settings)
        self.blocks = nn.ModuleList(
            QueryBlock(settings) for _ in range(settings.scene_blocks)
        )
        self.kind = mlp(width, width, len(KINDS))
        self.given_kind = nn.Embedding(len(KINDS), width)
        self.size = mlp(width, width, 3)
        by_bin = settings.heading_token
        self.heading = mlp(width, width, grid.num_headings) if by_bin else None
        self.turn = None if by_bin else mlp(width, width, 1)
        regressed = settings.position_token and not settings.offset_token
        self.offset = mlp(width, width, 2) if regressed else None
        features = settings.cell_feature_width if by_bin else 0
        self.bearings = (
            HeadingFeatures(width, features, grid.num_headings) if features else None
        )
        features, binned = settings.cell_feature_width, settings.offset_token
        self.offset_bins = OffsetFeatures(width, features, grid) if binned else None
        self.given_offset = OffsetEmbedding(width, grid) if binned else None
        spaced = settings.agent_spacing_width if binned else 0
        self.spacing = OffsetSpacing(width, spaced, grid) if spaced else None
        placed = binned and settings.placement_features
        self.placement = PlacementFeatures(width, grid) if placed else None

    def map_reach(self) -> NeighbourSpec:
        """How the query sees roads."""
        s = self.settings
        return NeighbourSpec.of(
            s.heading_query_radius_m, s.heading_query_map_neighbours, self.roads_relation
        )

    def agents_reach(self) -> NeighbourSpec:
        """How the query sees agents."""
        s = self.settings
        return NeighbourSpec.of(
            s.heading_query_radius_m, s.heading_query_agent_neighbours, self.agents_relation
        )

    def forward(
        self, cell: Tensor, roads: AttentionSources, agents: AttentionSources
    ) -> Tensor:
        """Describe the cells [N]: features [N, D]."""
        x: Tensor = self.query.weight[0] + self.cells(self.centre_m[cell])
        for block in self.blocks:
            x = block(x, roads, agents)
        return x

    def query_pose(self, cell: Tensor, offset_m: Tensor) -> Tensor:
        """Position of the query of a known inserted agent in the grid frame [N, 2]."""
        centre_m = self.centre_m[cell]
        return centre_m if self.settings.position_token else centre_m + offset_m

    def offset_logits(
        self,
        x: Tensor,
        agent_type: Tensor,
        pose: Tensor,
        roads: CellSources,
        agents: SpacedAgents | None,
        places: Places | None = None,
    ) -> Tensor:
        """Return logits of the offset bins [N, offset].

        Args:
            x: Updated features [N, D].
            agent_type: ``AgentType`` of each.
            pose: Pose of the query [N, 3] ...
            roads: ... and the map tokens seen from there ...
            agents: ... and the agents, if gaps to them are used.
            places: The places, if distances from road edges are used.
        """
        assert self.offset_bins is not None
        given = x + self.given_kind(agent_type)
        logits: Tensor = self.offset_bins(given, pose, roads)
        if self.spacing is not None and agents is not None:
            logits = logits + self.spacing.choose(given, pose, agents)
        if self.placement is not None and places is not None:
            logits = logits + self.placement.offsets(given, places)
        return logits

    def heading_logits(
        self,
        x: Tensor,
        agent_type: Tensor,
        offset: Tensor,
        pose: Tensor,
        roads: CellSources,
        places: Places | None = None,
    ) -> Tensor:
        """Return logits of headings [N, heading] at known offset bins [N].

        The other arguments are those of ``offset_logits``.
        """
        assert self.given_offset is not None
        assert self.heading is not None
        given = x + self.given_kind(agent_type) + self.given_offset(offset)
        logits: Tensor = self.heading(given)
        offset_m = self.given_offset.offset_m[offset]
        if self.bearings is not None:
            logits = logits + self.bearings(given, pose, roads, offset_m)
        if self.placement is not None and places is not None:
            logits = logits + self.placement.headings(given, places, offset_m)
        return logits

    def answer(
        self, rows: Rows, x: Tensor, agent_type: Tensor, pose: Tensor, roads: CellSources
    ) -> DetailOutputs:
        """Return logits of the type, and size, heading and offset per type.

        Without headings and offsets where these are bins: see ``offset_logits``.

        Args:
            rows: What the features are of.
            x: Updated features [N, ..., D].
            agent_type: ``AgentType`` of each.
            pose: Pose of the query [N, 3] ...
            roads: ... and the map tokens seen from there.
        """
        given = x + self.given_kind(agent_type)
        turn, offset = self.turn, self.offset
        is_last = self.offset_bins is None  # The heading is not given the offset.
        heading = self.heading(given) if self.heading is not None and is_last else None
        if self.bearings is not None and heading is not None:
            heading = heading + self.bearings(given, pose, roads)
        return DetailOutputs(
            rows,
            self.kind(x),
            self.size(given),
            heading,
            None if turn is None else math.pi * torch.tanh(turn(given)[..., 0]),
            None if offset is None else self.reach_m * torch.tanh(offset(given)),
        )


@dataclass(frozen=True, slots=True)
class DetailQuery:
    """The query of inserted agents' details, to go on with once more of them is known.

    Attributes:
        stack: What is queried.
        features: Features of the query [N, D].
        pose: Its pose [N, 3].
        roads: Map tokens that it sees.
        agents: Agents that it sees, if gaps to them are used.
        places: Where it is, if distances from road edges and angles to lanes are used.
    """

    stack: DetailStack
    features: Tensor
    pose: Tensor
    roads: CellSources
    agents: SpacedAgents | None = None
    places: Places | None = None

    @torch.no_grad()
    def offset_logits(self, agent_type: Tensor) -> Tensor:
        """Return logits of offset bins [N, offset] given agent types [N]."""
        x = self.features.float()
        with full_precision(x):
            return self.stack.offset_logits(
                x, agent_type, self.pose, self.roads, self.agents, self.places
            )

    @torch.no_grad()
    def heading_logits(self, agent_type: Tensor, offset: Tensor) -> Tensor:
        """Return logits of heading bins [N, heading] given offset bins [N] as well."""
        x = self.features.float()
        with full_precision(x):
            return self.stack.heading_logits(
                x, agent_type, offset, self.pose, self.roads, self.places
            )


@dataclass(frozen=True, slots=True)
class InsertionDetails:
    """Details of an inserted agent: sample a type, then take its row of the others.

    Attributes:
        agent_type_logits: ``AgentType`` given the cell.
        size_lwh_m: Box, given the agent type.
        heading_logits: Heading bin relative to the ego, given the agent type ...
        turned_rad: ... or the heading itself, relative to the ego.
        offset_m: Position less the cell's centre, in the ego's grid frame, given the agent
            type; None where the place was known already.
        query: Where the offset is sampled, and the heading given the offset, neither is
            here: they are queried by this.
    """

    agent_type_logits: Float32[Tensor, "rollout agent_type"]
    size_lwh_m: Float32[Tensor, "rollout agent_type 3"]
    heading_logits: Float32[Tensor, "rollout agent_type heading"] | None
    turned_rad: Float32[Tensor, "rollout agent_type"] | None
    offset_m: Float32[Tensor, "rollout agent_type 2"] | None
    query: DetailQuery | None = None
