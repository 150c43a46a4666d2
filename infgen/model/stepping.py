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

from dataclasses import replace

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.agents import AgentContext, AgentRows
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.batching.batch import MapTokens
from infgen.model.cell_features import CellSources
from infgen.model.features.removal import EgoPlace
from infgen.model.insertion import DetailQuery, InsertionBlocks, InsertionDetails
from infgen.model.layers import AttentionSources, full_precision, normed
from infgen.model.long_memory import Density, Standing, count_around, standing_after
from infgen.model.map_grid import MapGrid
from infgen.model.neighbours import (
    MapFeatures,
    cell_pose,
    find_map_neighbours,
    find_neighbours,
    find_others,
)
from infgen.model.network import EGO, Network
from infgen.model.relations import Rows, describe_pairs, within_radius
from infgen.model.rotary.turns import turned, turned_back
from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.token_step import MotionStep, PositionOutputs, TokenStep
from infgen.tokens.scene_tokens import Presence


class Stepper:
    """A network in evaluation mode with its tables made once, evaluated step by step.

    A network without a life cycle has no ``entry_`` methods: they raise ``ValueError``.
    """

    @torch.no_grad()
    def __init__(self, network: Network) -> None:
        self.network = network.eval()
        self._tables = network.embed.tables()
        self._past_table = network.motion.past_relation.table()
        self._shapes = network.motion.motion_features()
        self._map_reach = network.motion.map_reach()
        self._agents_reach = network.motion.agents_reach()
        self._asking: InsertionBlocks | None = None
        if network.cells is not None and network.details is not None:
            self._asking = InsertionBlocks.of(network.cells, network.details)

    @property
    def insertion_and_removal(self) -> bool:
        """Whether agents can enter; if not, the network knows motion only."""
        return self._asking is not None

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
        agents = _agent_rows(*memory.last(), standing, token_step, rows)
        x, sight = self._embed(agents), self._context(memory, token_step, rows, agents)
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

    @torch.no_grad()
    def entry_begin(
        self, memory: StepMemory, token_step: TokenStep, rows: Rows | None = None
    ) -> Insertions:
        """Look at the map and the agents around the ego, before any inserted agent.

        Args:
            memory: The past; ``motion_step`` has not been given the column yet.
            token_step: The column.
            rows: Its visible rows; who knows them saves waiting for their number.
        """
        rollouts, places = token_step.presence.shape
        raw = memory.features.new_zeros((rollouts, places, memory.features.shape[-1]))
        ego_pose = token_step.pose[:, EGO, None]
        each = torch.arange(rollouts, device=raw.device)
        roads = find_map_neighbours(
            self._asked().cell_roads,
            Rows(each, each[:, None]),
            ego_pose,
            memory.roads,
            memory.scene,
        )
        within = torch.zeros_like(token_step.observed)
        nobody = replace(
            token_step, presence=torch.zeros_like(token_step.presence), observed=within
        )
        before, known = memory.last()
        empty = Insertions(
            token=memory.columns,
            rollout=each,
            map=memory.roads,
            scene=memory.scene,
            before=before,
            known=known,
            average=memory.average,
            standing=memory.standing,
            token_step=nobody,
            raw=raw,
            relation=raw.new_zeros(
                (rollouts, places, self.network.settings.relation_features)
            ),
            within=within,
            roads=roads,
            cell_features=None,
        )
        entries = self.entry_add(empty, token_step, rows)
        return replace(entries, cell_features=self._cell_features(entries))

    @torch.no_grad()
    def entry_add(
        self,
        entries: Insertions,
        token_step: TokenStep,
        fresh: Rows | None = None,
        real: Bool[Tensor, " row"] | None = None,
    ) -> Insertions:
        """Go on with inserted agents as further visible rows of the same column.

        Args:
            entries: The column so far.
            token_step: The column with the inserted agents.
            fresh: Their rows; who knows them saves waiting for their number.
            real: Which of these rows hold an inserted agent; all of them if None.
        """
        if fresh is None:
            fresh = Rows.where(token_step.visible & ~entries.token_step.visible)
        some = torch.ones_like(fresh.at, dtype=torch.bool) if real is None else real
        came = fresh.spread(some)
        before = entries.before, entries.known
        standing = standing_after(entries.standing, *before, token_step)
        ego_pose = token_step.pose[:, EGO, None].expand_as(token_step.pose)
        reach, pose = self._asked().cell_agents, fresh.pack(token_step.pose)
        related = reach.describe(fresh.pack(ego_pose), pose[:, None]).values[:, 0]
        agents = _agent_rows(*before, standing, token_step, fresh)
        embedded = normed(self._embed(agents))
        embedded = turned(embedded, reach.relation.turn(pose))
        within = came & within_radius(ego_pose, token_step.pose, reach.radius_m)
        for kept, new in ((entries.raw, embedded), (entries.relation, related)):
            flat = kept.flatten(0, 1)
            if real is not None:
                new = torch.where(real[:, None], new, flat[fresh.at])
            flat.index_copy_(0, fresh.at, new.to(flat.dtype))
        return replace(entries, token_step=token_step, within=entries.within | within)

    @torch.no_grad()
    def entry_query(self, entries: Insertions) -> PositionOutputs:
        """Ask for the next inserted agent of every rollout that goes on."""
        cells, agents = self._asked().cells, entries.agents()
        occupied = cells.occupied(entries.active(entries.token_step.cell), agents.present)
        roads, cell_features = entries.around()
        average = entries.active(entries.average)
        x = cells(occupied[:, None], roads, agents, average)[:, 0]
        each = torch.arange(len(x), device=x.device)
        rows, queries = Rows(each, each), x[:, None].float()
        with full_precision(x):
            said = cells.answer(rows, queries, cell_features)
        return PositionOutputs(
            said.add_logit[:, 0],
            None if said.position_logits is None else said.position_logits[:, 0],
            None if said.position_m is None else said.position_m[:, 0],
        )

    @torch.no_grad()
    def entry_details(
        self,
        entries: Insertions,
        cell: Int64[Tensor, " active"],
        position_m: Float32[Tensor, "active 2"] | None = None,
    ) -> InsertionDetails:
        """Query the details of an inserted agent at a cell of every rollout that goes on.

        Args:
            entries: The token step.
            cell: The cells.
            position_m: Where in them, in the ego's grid frame; their centres if None.
        """
        asking, token_step = self._asked(), entries.token_step
        details = asking.details
        position_m = details.centre_m[cell] if position_m is None else position_m
        agents_pose = entries.active(token_step.pose)
        pose = cell_pose(agents_pose[:, EGO], position_m)[:, None]
        each = torch.arange(len(cell), device=cell.device)
        rows = Rows(each, each[:, None])
        around = find_neighbours(
            asking.detail_agents,
            rows,
            pose,
            agents_pose,
            entries.rows(),
            entries.active(token_step.visible)[:, None],
        )
        roads = find_map_neighbours(
            asking.detail_roads, rows, pose, entries.map, entries.active(entries.scene)
        )
        x = details(cell, roads, around.seen(entries.raw.flatten(0, 1)))
        kinds = torch.arange(details.given_kind.num_embeddings, device=cell.device)
        near = CellSources.near(entries.map, roads)
        with full_precision(x):
            said = details.answer(rows, x[:, None].float(), kinds, pose[:, 0], near)
        sampled = details.offset_bins is not None
        return InsertionDetails(
            said.agent_type_logits[:, 0],
            said.size_log_m.exp(),
            said.heading_logits,
            said.turned_rad,
            said.offset_m,
            DetailQuery(details, x, pose[:, 0], near) if sampled else None,
        )

    def _cell_features(self, entries: Insertions) -> Tensor | None:
        """Describe the cells around every ego, before any inserted agent."""
        cell_features, token_step = self._asked().cells.cell_features, entries.token_step
        if cell_features is None:
            return None
        row = torch.arange(token_step.presence.numel(), device=token_step.pose.device)
        there = token_step.visible & (token_step.presence != int(Presence.INSERTED))
        turn = self._asked().cell_agents.relation.turn(token_step.pose)
        features = turned_back(entries.raw, turn).flatten(0, 1)
        lying = CellSources(
            features, row.view_as(token_step.presence), token_step.pose, there
        )
        roads = CellSources.roads(entries.map, entries.scene)
        described: Tensor = cell_features(token_step.pose[:, EGO], roads, lying)
        return described

    def _asked(self) -> InsertionBlocks:
        if self._asking is None:
            raise ValueError(
                "these weights know motion only (model.insertion_and_removal is false): "
                "it cannot insert agents"
            )
        return self._asking

    def _count(self, token_step: TokenStep) -> Tensor:
        """Count the agents around each ego [rollout]."""
        return count_around(
            token_step.pose[:, EGO],
            token_step.pose,
            token_step.visible,
            self.network.settings.position_query_radius_m,
        )

    def _embed(self, agents: AgentRows) -> Tensor:
        embedded: Tensor = self.network.embed(agents, self._tables)
        return embedded

    def _context(
        self, memory: StepMemory, token_step: TokenStep, rows: Rows, agents: AgentRows
    ) -> AgentContext:
        """What the visible rows of a column see."""
        visible = token_step.visible
        around = find_others(self._agents_reach, rows, token_step.pose, visible)
        pose, rollout = agents.pose, rows.at // visible.shape[1]
        scene, token = memory.scene[rollout], memory.columns - memory.begun[rollout]
        added = self.network.motion.added(agents, around, memory.roads, scene, token)
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
            Shared.of(related), past, turn, roads, around, added, density, ego_place
        )


def _agent_rows(
    before: Tensor,
    known: Tensor,
    standing: Standing | None,
    token_step: TokenStep,
    rows: Rows,
) -> AgentRows:
    """Take some rows of a token step, given the poses known before it."""
    return AgentRows(
        agent_type=rows.pack(token_step.agent_type),
        size_lwh_m=rows.pack(token_step.size_lwh_m),
        pose=rows.pack(token_step.pose),
        before=rows.pack(before),
        known=rows.pack(known),
        motion_token=rows.pack(token_step.motion_token),
        presence=rows.pack(token_step.presence),
        cell=rows.pack(token_step.cell),
        ego=rows.at % token_step.cell.shape[-1] == EGO,
        standing=None if standing is None else standing.take(rows.at),
    )
