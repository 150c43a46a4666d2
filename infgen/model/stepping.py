"""The network played one token step at a time, for many rollouts at once.

The same logits as ``Network.forward``, without ever computing a past column again. One
token step ``c`` of a closed loop::

    stepper = Stepper(network)                       # eval, tables built once
    memory = stepper.begin(roads, scene, rows=128)   # map encoded once per scene
    for column in history: stepper.motion_step(memory, column)   # all but the last one
    ...
    entries = stepper.entry_begin(memory, column)    # map part, once per half second
    while some rollout goes on:
        query = stepper.entry_query(entries)         # add?  which cell?
        details = stepper.entry_details(entries, cell)   # kind; the rest given the agent
        type column = ...  # with inserted agents as rows: ENTERING, not observed entries =
        stepper.entry_add(entries, column)
    motion = stepper.motion_step(memory, column)     # next motion token, leaving next?

Dims: ``rollout`` is any mix of scenes and rollouts of them, ``row`` the places for agents.
Row 0 is always the ego. A row that is ABSENT costs nothing. A row that is INSERTED starts
with an empty past, so a freed row can be given to an inserted agent as it is.
"""

import torch
from jaxtyping import Int64
from torch import Tensor

from infgen.model.agent_embedding import AgentRows
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.batching.batch import MapTokens
from infgen.model.features.removal import EgoPlace
from infgen.model.insertion_stepping import InsertionStepper, agent_rows
from infgen.model.layers import AttentionSources, full_precision, normed
from infgen.model.long_memory import Density, count_around, standing_after
from infgen.model.map_grid import MapGrid
from infgen.model.motion_stack import AgentContext
from infgen.model.neighbours import (
    MapFeatures,
    find_map_neighbours,
    find_others,
)
from infgen.model.network import Network
from infgen.model.relations import Rows, describe_pairs
from infgen.model.rotary.turns import turned
from infgen.model.step_memory import StepMemory
from infgen.model.token_step import MotionStep, TokenStep
from infgen.tokens.scene_tokens import EGO, Presence


class Stepper(InsertionStepper):
    """A network in evaluation mode with its tables made once, evaluated step by step."""

    @torch.no_grad()
    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self._past_table = network.motion.past_relation.table()
        self._shapes = network.motion.motion_features()
        self._map_reach = network.motion.map_reach()
        self._agents_reach = network.motion.agents_reach()

    @property
    def leaves(self) -> bool:
        """Whether the network has removal logits."""
        return self.network.motion.leave is not None

    @torch.no_grad()
    def begin(
        self, roads: MapTokens, scene: Int64[Tensor, " rollout"], rows: int
    ) -> StepMemory:
        """Encode maps and start with an empty past.

        Args:
            roads: Map of each scene (``batch.collate_roads(records, max_map_tokens)``).
            scene: Scene of each rollout.
            rows: Places for agents.
        """
        encoder = self.network.roads
        return self.begin_on(encoder(roads, encoder.look(roads)), scene, rows)

    @torch.no_grad()
    def encode_maps(self, roads: MapTokens) -> Tensor:
        """Return what every map token is [row, D], map after map: what ``begin`` costs."""
        return self.network.roads.encode(roads, self.network.roads.look(roads))

    @torch.no_grad()
    def lay_out_maps(self, roads: MapTokens, encoded: Tensor) -> MapFeatures:
        """Put maps side by side that were encoded before, together or one by one."""
        rows, grid = Rows.where(roads.real), MapGrid.of(roads.pose, roads.real)
        return self.network.roads.lay_out(roads, rows, grid, encoded)

    @torch.no_grad()
    def begin_on(
        self, maps: MapFeatures, scene: Int64[Tensor, " rollout"], rows: int
    ) -> StepMemory:
        """Start with an empty past on encoded maps; arguments are those of ``begin``."""
        return StepMemory.empty(maps, scene, rows, self.network.settings)

    @torch.no_grad()
    def motion_step(
        self, memory: StepMemory, token_step: TokenStep, rows: Rows | None = None
    ) -> MotionStep:
        """Append a column to the past and say what follows it. Once per column.

        Args:
            memory: The past.
            token_step: The column.
            rows: Its visible rows; who knows them saves waiting for their number.
        """
        motion = self.network.motion
        visible = token_step.visible
        rows = Rows.where(visible) if rows is None else rows
        memory.visible &= (token_step.presence != int(Presence.INSERTED))[..., None]
        standing = standing_after(memory.standing, *memory.last(), token_step)
        agents = agent_rows(*memory.last(), standing, token_step, rows)
        x = self._embed(agents)
        sight = self._context(memory, token_step, rows, agents, x)
        x = x if sight.added is None else x + sight.added
        place = memory.columns % memory.window
        ring = torch.arange(memory.window, device=visible.device)
        past_index = rows.at[:, None] * memory.window + ring
        for block, past in zip(motion.blocks, memory.features, strict=True):
            before = turned(normed(x), sight.past_turn)
            own = AttentionSources(
                past.flatten(0, 2),
                past_index,
                sight.past_relation,
                sight.past_present,
                sight.past_turn,
            )
            x = block(x, own, sight)
            past.flatten(0, 1)[rows.at, place] = before.to(past.dtype)
        memory.pose[:, :, place] = token_step.pose
        memory.visible[:, :, place] = visible
        memory.standing = standing
        if self.network.settings.density_features:
            memory.count(self._count(token_step))
        memory.columns += 1
        agent_type = rows.pack(token_step.agent_type)
        with full_precision(x):
            return MotionStep(
                motion.foretell(rows, x.float(), agent_type, self._shapes, sight)
            )

    def _count(self, token_step: TokenStep) -> Tensor:
        """Count the agents around each ego [rollout]."""
        return count_around(
            token_step.pose[:, EGO],
            token_step.pose,
            token_step.visible,
            self.network.settings.position_query_radius_m,
        )

    def _context(
        self,
        memory: StepMemory,
        token_step: TokenStep,
        rows: Rows,
        agents: AgentRows,
        x: Tensor,
    ) -> AgentContext:
        """What the visible rows of a column see, whose embeddings are ``x``."""
        visible = token_step.visible
        around = find_others(self._agents_reach, rows, token_step.pose, visible)
        pose, rollout = agents.pose, rows.at // visible.shape[1]
        scene, token = memory.scene[rollout], memory.columns - memory.begun[rollout]
        moving = self.network.motion.moving(agents, around)
        edges = self.network.motion.edges_near(agents, memory.roads, scene)
        added = self.network.motion.added(pose, moving, memory.roads, scene, token)
        roads = find_map_neighbours(
            self._map_reach, rows, token_step.pose, memory.roads, memory.scene, token
        )
        place = torch.arange(memory.window, device=visible.device)
        ago = (place - memory.columns) % memory.window - memory.window  # -window ... -1
        relation, past_pose = self.network.motion.past_relation, rows.pack(memory.pose)
        ago = ago.to(pose.dtype).expand(len(rows.at), -1)
        related = describe_pairs(relation, self._past_table, pose, past_pose, ago=ago)
        turn = relation.turn(pose, float(memory.columns))
        past = rows.pack(memory.visible)
        density = None
        if self.network.settings.density_features:
            count = self._count(token_step)
            density = Density(count, memory.averages_before(count)).take(rollout)
        ego_place = None
        if self.network.motion.ego_place is not None:
            ego_place = EgoPlace(
                pose,
                token_step.pose[:, EGO][rollout],
                agents.before,
                memory.last()[0][:, EGO][rollout],
                agents.known,
            )
        return AgentContext(
            Shared.of(related),
            past,
            turn,
            roads,
            around,
            moving,
            edges,
            self.network.motion.inserted_over_edge(agents, edges),
            self.network.motion.last_move(agents),
            added,
            density,
            ego_place,
            self.network.motion.ego_told(x, rows, visible),
        )
