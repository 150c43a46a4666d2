"""Agents as features, and what they do next.

Shape letters as in ``layers``; rows are the visible agents of all tokens and scenes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from infgen.clock import CLOCK
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.features.approach import ApproachFeatures, MovingPairs
from infgen.model.features.removal import EgoPlace, RemovalFeatures
from infgen.model.features.signals import SignalAhead
from infgen.model.layers import (
    Attention,
    AttentionSources,
    FourierEmbedding,
    embedding_mlp,
    gather,
    mlp,
    normed,
)
from infgen.model.logits import MotionOutputs
from infgen.model.long_memory import (
    Density,
    DensityFeatures,
    Standing,
    StandingFeatures,
)
from infgen.model.motion_head import MotionHead
from infgen.model.neighbours import MapFeatures, NeighbourRows, NeighbourSpec
from infgen.model.relations import Rows, direction, relation_embedding
from infgen.model.rotary.turns import turned
from infgen.model.settings import ModelSettings
from infgen.scene import AgentType
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)
from infgen.tokens.vocabulary import MotionVocabulary

NUM_PATTERNS = 1 << CLOCK.steps_per_token
KINDS = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)
MAX_SPEED_MPS = 50.0
"""Past displacements are clipped at this speed."""

ENTERING_M = -1.0
"""Stands for the last displacement of an agent that is just entering ..."""
UNKNOWN_M = -2.0
"""... or whose last pose was not seen. No true displacement is negative."""


@dataclass(frozen=True, slots=True)
class AgentRows:
    """Agents to embed, one per row.

    Attributes:
        agent_type: ``AgentType`` [row].
        size_lwh_m: Boxes [row, 3].
        pose: Poses [row, 3].
        before: Poses one token step earlier [row, 3] ...
        known: ... and whether they were seen [row].
        motion_token: Vocabulary row, ``FIRST_MOTION_TOKEN`` or ``NO_MOTION_TOKEN`` [row].
        presence: ``Presence`` [row].
        cell: Cell of the ego's grid, or ``NO_CELL`` [row].
        ego: Whether it is the ego [row].
        standing: For how long each has stood [row], if that is used.
    """

    agent_type: Tensor
    size_lwh_m: Tensor
    pose: Tensor
    before: Tensor
    known: Tensor
    motion_token: Tensor
    presence: Tensor
    cell: Tensor
    ego: Tensor
    standing: Standing | None

    def moving(self, around: NeighbourRows) -> MovingPairs:
        """Return how they move, and the others around each."""
        known = self.known & (self.presence != int(Presence.INSERTED))
        step_m = (self.pose - self.before)[:, :2] * known[:, None]
        size_lw_m = self.size_lwh_m[:, :2]
        return MovingPairs(self.pose, step_m, size_lw_m, around.index, around.present)


@dataclass(frozen=True, slots=True)
class AgentTables:
    """Embeddings that depend on no scene.

    Attributes:
        moves: Of every agent type's motion tokens, then ``FIRST_MOTION_TOKEN``, then
            ``NO_MOTION_TOKEN``.
        cells: Of every cell, then ``NO_CELL``; None without a life cycle.
    """

    moves: Tensor
    cells: Tensor | None


class AgentEmbedding(nn.Module):
    """What an agent is and did last, by itself (SPEC 4.4).

    Where it is in its life and in the ego's grid is left out where only motion is modelled.
    """

    corners_m: Tensor
    centre_m: Tensor

    def __init__(
        self, settings: ModelSettings, vocabulary: MotionVocabulary, grid: Grid
    ) -> None:
        super().__init__()
        width, life = settings.width, settings.insertion_and_removal
        self.num_motion_tokens = vocabulary.num_motion_tokens
        self.num_cells = grid.num_cells
        corners_m = torch.from_numpy(vocabulary.end_corners_m.copy())
        self.register_buffer("corners_m", corners_m.flatten(2), persistent=False)
        centre_m = torch.from_numpy(grid.centre_m.copy())
        self.register_buffer("centre_m", centre_m, persistent=False)
        self.moves = nn.ModuleList(embedding_mlp(8, width) for _ in KINDS)
        self.special_moves = nn.Embedding(2, width)
        self.cells = embedding_mlp(2, width) if life else None
        self.no_cell = nn.Embedding(1, width) if life else None
        self.motion = FourierEmbedding(2, settings.fourier_bands, width)
        self.kind = nn.Embedding(len(KINDS), width)
        self.size = embedding_mlp(3, width)
        self.ego = nn.Parameter(torch.zeros(width)) if settings.ego_embedding else None
        self.presence = nn.Embedding(len(Presence), width) if life else None
        self.fuse = embedding_mlp((4 if life else 2) * width, width)
        self.standing = StandingFeatures(width) if settings.standing_features else None

    def tables(self) -> AgentTables:
        """Embed all motion tokens and cells."""
        moves = [mlp(m) for mlp, m in zip(self.moves, self.corners_m, strict=True)]
        cells = None
        if self.cells is not None and self.no_cell is not None:
            cells = torch.cat([self.cells(self.centre_m), self.no_cell.weight])
        return AgentTables(torch.cat([*moves, self.special_moves.weight]), cells)

    def forward(self, agents: AgentRows, tables: AgentTables) -> Tensor:
        """Embed agents: [N, D]."""
        motion_token = agents.agent_type * self.num_motion_tokens + agents.motion_token
        special = len(KINDS) * self.num_motion_tokens
        motion_token = torch.where(
            agents.motion_token == FIRST_MOTION_TOKEN, special, motion_token
        )
        motion_token = torch.where(
            agents.motion_token == NO_MOTION_TOKEN, special + 1, motion_token
        )
        what = self.kind(agents.agent_type) + self.size(agents.size_lwh_m)
        if self.ego is not None:
            what = what + agents.ego[:, None] * self.ego
        parts = [
            gather(tables.moves, motion_token),
            self.motion(_last_motion(agents), what),
        ]
        if self.presence is not None and tables.cells is not None:
            cell = torch.where(agents.cell == NO_CELL, self.num_cells, agents.cell)
            parts += [self.presence(agents.presence), gather(tables.cells, cell)]
        embedded: Tensor = self.fuse(torch.cat(parts, dim=-1))
        if self.standing is not None and agents.standing is not None:
            embedded = embedded + self.standing(agents.standing)
        return embedded


def _last_motion(agents: AgentRows) -> Tensor:
    """Length and direction, as the agent sees it, of its last displacement [N, 2].

    What there is no displacement for gets a length that none can have, so nothing of the
    world's axes gets into the features.
    """
    away_m = agents.pose[:, :2] - agents.before[:, :2]
    length_m = away_m.square().sum(dim=-1).sqrt()
    turned_rad = direction(away_m, agents.pose[:, 2])
    entering = agents.presence == int(Presence.INSERTED)
    length_m = torch.where(agents.known, length_m, UNKNOWN_M)
    length_m = torch.where(entering, ENTERING_M, length_m)
    turned_rad = torch.where(agents.known & ~entering, turned_rad, 0.0)
    return torch.stack([length_m, turned_rad], dim=-1)


@dataclass(frozen=True, slots=True)
class AgentContext:
    """What agents see, for all blocks alike.

    Attributes:
        past_relation: Relations to their own past [N, K, D] ...
        past_present: ... and which of it there is [N, K].
        past_turn: By what features are turned by heading and time [N, P], if they are.
        roads: Map tokens around them.
        agents: Rows of the agents around them.
        added: Added to their features [N, D], if anything is: ``MotionStack.added``.
        density: Agents around the ego of each [N], if that is used.
        ego_place: Where they are to the ego [N], if that is used.
    """

    past_relation: Shared
    past_present: Tensor
    past_turn: Tensor | None
    roads: AttentionSources
    agents: NeighbourRows
    added: Tensor | None
    density: Density | None
    ego_place: EgoPlace | None


class MotionBlock(nn.Module):
    """One look at the own past, the roads, and the other agents."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.past = Attention(settings, bipartite=False)
        self.roads = Attention(settings, bipartite=True)
        self.agents = Attention(settings, bipartite=False)

    def forward(self, x_ND: Tensor, past: AttentionSources, sight: AgentContext) -> Tensor:
        """Update agents; ``past`` are they themselves at earlier tokens."""
        x_ND = self.past(x_ND, past)
        x_ND = self.roads(x_ND, sight.roads)
        shown = turned(normed(x_ND), sight.agents.turn)
        updated: Tensor = self.agents(x_ND, sight.agents.seen(shown))
        return updated


class MotionStack(nn.Module):
    """What every agent does next, all at once (SPEC 4.5)."""

    def __init__(
        self, settings: ModelSettings, vocabulary: MotionVocabulary, token_s: float
    ) -> None:
        super().__init__()
        width = settings.width
        window = settings.temporal_window_tokens
        far_m = MAX_SPEED_MPS * token_s * window
        self.settings = settings
        self.past_relation = relation_embedding(far_m, settings, window)
        self.roads_relation = relation_embedding(
            settings.map_agent_radius_m + settings.map_agent_lookahead_m,
            settings,
            across=settings.map_agent_lateral_offset,
        )
        self.agents_relation = relation_embedding(settings.agent_agent_radius_m, settings)
        self.blocks = nn.ModuleList(
            MotionBlock(settings) for _ in range(settings.motion_blocks)
        )
        shaped = settings.motion_feature_width
        self.move = None if shaped else mlp(width, width, vocabulary.num_motion_tokens)
        self.shaped = MotionHead(width, shaped, vocabulary) if shaped else None
        leaves = settings.insertion_and_removal and settings.remove_token
        self.leave = mlp(width, width, 1) if leaves else None
        crowded = leaves and settings.density_features
        self.density = DensityFeatures(width) if crowded else None
        self.ego_place = (
            RemovalFeatures(width, settings.position_query_radius_m)
            if leaves and settings.removal_features
            else None
        )
        patterns = settings.validity_pattern_tokens
        self.pattern = mlp(width, width, NUM_PATTERNS) if patterns else None
        ahead_m = settings.signal_ahead_m
        self.light = SignalAhead(width, ahead_m) if ahead_m else None
        self.approach = ApproachFeatures(width) if settings.approach_features else None

    def map_reach(self) -> NeighbourSpec:
        """How agents see roads."""
        s = self.settings
        return NeighbourSpec.of(
            s.map_agent_radius_m,
            s.map_agent_neighbours,
            self.roads_relation,
            ahead_m=s.map_agent_lookahead_m,
            across=s.map_agent_lateral_offset,
        )

    def agents_reach(self) -> NeighbourSpec:
        """How agents see each other."""
        s = self.settings
        return NeighbourSpec.of(
            s.agent_agent_radius_m, s.agent_agent_neighbours, self.agents_relation
        )

    def added(
        self,
        agents: AgentRows,
        around: NeighbourRows,
        roads: MapFeatures,
        scene: Tensor,
        token: Tensor,
    ) -> Tensor | None:
        """Tell agents what the signals ahead show, and who comes near [N, D].

        Args:
            agents: The agents.
            around: Others around each.
            roads: Maps.
            scene: Map of each [N].
            token: Token step of each [N].
        """
        found: Tensor | None = None
        if self.light is not None and roads.lines is not None:
            found = self.light(roads.lines, agents.pose, scene, token)
        if self.approach is not None:
            coming: Tensor = self.approach(agents.moving(around))
            found = coming if found is None else found + coming
        return found

    def forward(self, x_ND: Tensor, past_index: Tensor, sight: AgentContext) -> Tensor:
        """Update the agents of all tokens; ``past_index`` are rows of their own past."""
        x_ND = x_ND if sight.added is None else x_ND + sight.added
        for block in self.blocks:
            past = AttentionSources(
                turned(normed(x_ND), sight.past_turn),
                past_index,
                sight.past_relation,
                sight.past_present,
                sight.past_turn,
            )
            x_ND = block(x_ND, past, sight)
        return x_ND

    def motion_features(self) -> Tensor | None:
        """Evaluate the features of the motion tokens for one pass, if they are used."""
        return None if self.shaped is None else self.shaped.table()

    def foretell(
        self,
        rows: Rows,
        x_ND: Tensor,
        agent_type: Tensor,
        shapes: Tensor | None,
        sight: AgentContext,
    ) -> MotionOutputs:
        """Say of every row what it does next.

        Args:
            rows: The visible agents.
            x_ND: Their updated features.
            agent_type: ``AgentType`` of each.
            shapes: ``motion_features``.
            sight: What they see.
        """
        leaving = x_ND
        if self.density is not None and sight.density is not None:
            leaving = leaving + self.density(sight.density)
        if self.ego_place is not None and sight.ego_place is not None:
            leaving = leaving + self.ego_place(sight.ego_place)
        return MotionOutputs(
            rows,
            self._moves(x_ND, agent_type, shapes),
            None if self.leave is None else self.leave(leaving)[:, 0],
            None if self.pattern is None else self.pattern(x_ND),
        )

    def _moves(self, x_ND: Tensor, agent_type: Tensor, shapes: Tensor | None) -> Tensor:
        if self.shaped is not None and shapes is not None:
            shaped: Tensor = self.shaped(x_ND, agent_type, shapes)
            return shaped
        if self.move is None:
            raise ValueError("the motion head needs features; pass motion_features()")
        alone: Tensor = self.move(x_ND)
        return alone
