"""What agents do next.

Shape letters as in ``layers``; rows are the visible agents of all tokens and scenes.
"""

from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor, nn

from infgen.clock import CLOCK
from infgen.model.agent_embedding import AgentRows
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.features.approach import ApproachFeatures, MovingPairs
from infgen.model.features.clearance import Clearance
from infgen.model.features.edge_clearance import EdgeClearance, EdgesNear
from infgen.model.features.ego import EgoFeatures
from infgen.model.features.last_move import LastMove, LastMoveHead
from infgen.model.features.over_edge import OverEdgeHead
from infgen.model.features.removal import EgoPlace, RemovalFeatures
from infgen.model.features.signals import SignalAhead
from infgen.model.layers import Attention, AttentionSources, mlp, normed
from infgen.model.logits import MotionOutputs
from infgen.model.long_memory import Density, DensityFeatures
from infgen.model.motion_head import MotionHead
from infgen.model.neighbours import MapFeatures, NeighbourRows, NeighbourSpec
from infgen.model.relations import Rows, relation_embedding
from infgen.model.rotary.turns import turned
from infgen.model.settings import ModelSettings
from infgen.tokens.scene_tokens import EGO
from infgen.tokens.vocabulary import MotionVocabulary

NUM_PATTERNS = 1 << CLOCK.steps_per_token
MAX_SPEED_MPS = 50.0
"""Past displacements are clipped at this speed."""


@dataclass(frozen=True, slots=True)
class AgentContext:
    """What agents see, for all blocks alike.

    Attributes:
        past_relation: Relations to their own past [N, K, D] ...
        past_present: ... and which of it there is [N, K].
        past_turn: By what features are turned by heading and time [N, P], if they are.
        roads: Map tokens around them.
        agents: Rows of the agents around them.
        moving: How they and others around them move, if that is used.
        edges: Road edges near them, if that is used.
        over_edge: How far those just inserted are over an edge, if that is used.
        last: How they moved last, if that is used.
        added: Added to their features [N, D], if anything is: ``MotionStack.added``.
        density: Agents around the ego of each [N], if that is used.
        ego_place: Where they are to the ego [N], if that is used.
        ego: What removal is told of the ego [N, D], if that is used.
    """

    past_relation: Shared
    past_present: Tensor
    past_turn: Tensor | None
    roads: AttentionSources
    agents: NeighbourRows
    moving: MovingPairs | None
    edges: EdgesNear | None
    over_edge: Tensor | None
    last: LastMove | None
    added: Tensor | None
    density: Density | None
    ego_place: EgoPlace | None
    ego: Tensor | None


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
        self.ego = EgoFeatures(width) if leaves and settings.ego_features else None
        patterns = settings.validity_pattern_tokens
        self.pattern = mlp(width, width, NUM_PATTERNS) if patterns else None
        ahead_m = settings.signal_ahead_m
        self.light = SignalAhead(width, ahead_m) if ahead_m else None
        self.approach = ApproachFeatures(width) if settings.approach_features else None
        clear, of_edges = settings.clearance_width, settings.edge_clearance_width
        self.clearance = Clearance(width, clear, vocabulary) if clear else None
        self.edges = EdgeClearance(width, of_edges, vocabulary) if of_edges else None
        self.last = LastMoveHead(width, vocabulary) if settings.last_move_head else None
        over_edge = settings.over_edge_head
        self.over_edge = OverEdgeHead(width, vocabulary) if over_edge else None

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

    def moving(self, agents: AgentRows, around: NeighbourRows) -> MovingPairs | None:
        """Say how agents move, and the others around each, if that is used."""
        if self.approach is None and self.clearance is None:
            return None
        return agents.moving(around)

    def edges_near(
        self, agents: AgentRows, roads: MapFeatures, scene: Tensor
    ) -> EdgesNear | None:
        """Find the road edges near agents on maps ``scene`` [N], if that is used."""
        if roads.edges is None or (self.edges is None and self.over_edge is None):
            return None
        step_m, _ = agents.moved()
        size_lw_m = agents.size_lwh_m[:, :2]
        return EdgesNear.of(roads.edges, agents.pose, step_m, size_lw_m, scene)

    def inserted_over_edge(
        self, agents: AgentRows, edges: EdgesNear | None
    ) -> Tensor | None:
        """Say how far just inserted agents are over an edge, if that is used."""
        if self.over_edge is None or edges is None:
            return None
        _, moved = agents.moved()
        return self.over_edge.passed(edges, ~moved)

    def last_move(self, agents: AgentRows) -> LastMove | None:
        """Find how agents moved last, if that is used."""
        if self.last is None:
            return None
        _, known = agents.moved()
        return LastMove.between(agents.before, agents.pose, known)

    def ego_told(self, x_ND: Tensor, rows: Rows, visible: Tensor) -> Tensor | None:
        """Tell removal what the ego of every agent does [N, D], if that is used.

        Args:
            x_ND: Embeddings of the agents.
            rows: Their rows.
            visible: All agents [..., agent] that are there.
        """
        if self.ego is None:
            return None
        number = rows.number[..., EGO].flatten()
        there = visible[..., EGO].flatten()[:, None]
        told: Tensor = self.ego(normed(x_ND)[number] * there)
        return told[rows.at // visible.shape[-1]]

    def added(
        self,
        pose: Tensor,
        moving: MovingPairs | None,
        roads: MapFeatures,
        scene: Tensor,
        token: Tensor,
    ) -> Tensor | None:
        """Tell agents what the signals ahead show, and who comes near [N, D].

        Args:
            pose: Poses of the agents [N, 3].
            moving: How they and others move.
            roads: Maps.
            scene: Map of each [N].
            token: Token step of each [N].
        """
        found: Tensor | None = None
        if self.light is not None and roads.lines is not None:
            found = self.light(roads.lines, pose, scene, token)
        if self.approach is not None and moving is not None:
            coming: Tensor = self.approach(moving)
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
        if sight.ego is not None:
            leaving = leaving + sight.ego
        return MotionOutputs(
            rows,
            self._moves(x_ND, agent_type, shapes, sight),
            None if self.leave is None else self.leave(leaving)[:, 0],
            None if self.pattern is None else self.pattern(x_ND),
        )

    def _moves(
        self, x_ND: Tensor, agent_type: Tensor, shapes: Tensor | None, sight: AgentContext
    ) -> Tensor:
        """Logits of motion tokens [N, V]."""
        if self.shaped is not None and shapes is not None:
            moves: Tensor = self.shaped(x_ND, agent_type, shapes)
        elif self.move is not None:
            moves = self.move(x_ND)
        else:
            raise ValueError("the motion head needs features; pass motion_features()")
        if self.last is not None and sight.last is not None:
            moves = moves + self.last(x_ND, agent_type, sight.last)
        if self.over_edge is not None and sight.over_edge is not None:
            moves = moves + self.over_edge(x_ND, agent_type, sight.over_edge)
        heads = (self.clearance, sight.moving), (self.edges, sight.edges)
        judged = [
            head(x_ND, agent_type, seen)
            for head, seen in heads
            if head is not None and seen is not None
        ]
        head = self.edges if self.clearance is None else self.clearance
        if head is None or not judged:
            return moves
        return moves + head.spread(reduce(torch.add, judged), agent_type)
