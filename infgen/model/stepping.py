"""The network played one half second at a time, for many rollouts at once.

The same logits as ``Network.forward``, without ever computing a past column again. One half
second ``c`` of a closed loop::

    stepper = Stepper(network)                       # eval, tables built once
    memory = stepper.begin(roads, scene, rows=128)   # map encoded once per scene
    for column in history: stepper.motion_step(memory, column)   # all but the last one
    ...
    entries = stepper.entry_begin(memory, column)    # map part, once per half second
    while some rollout goes on:
        query = stepper.entry_query(entries)         # add?  which cell?
        details = stepper.entry_details(entries, cell)   # kind; the rest given the kind
        column = (column with newcomers as rows: INSERTED, FIRST_MOTION_TOKEN,
        observed=False) entries = stepper.entry_add(entries, column)
    motion = stepper.motion_step(memory, column)     # next move, leaving next?

Dims: ``rollout`` is any mix of scenes and rollouts of them, ``row`` the places for agents.
Row 0 is always the ego. A row that is ABSENT costs nothing. A row that is INSERTED starts
with an empty past, so a freed row can be given to a newcomer as it is.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from infgen.model.agents import AgentRows, Sight
from infgen.model.batching.batch import Roads
from infgen.model.cell_features import Lying
from infgen.model.insertion import CellStack, DetailStack
from infgen.model.layers import Seen, normed
from infgen.model.neighbour_attention import Shared
from infgen.model.neighbours import Reach, RoadFeatures, cell_pose, look_around, see_roads
from infgen.model.network import EGO, Network
from infgen.model.relations import Rows, relations, within_radius
from infgen.model.token_step import Column, EntryDetails, EntryQuery, MotionStep
from infgen.tokens.scene_tokens import Presence


@dataclass(slots=True)
class Memory:
    """What the past leaves behind. ``motion_step`` writes into it.

    The ring holds the last ``window`` columns; column c is at place c modulo window.

    Attributes:
        roads: Encoded maps, one per scene.
        scene: Map of each rollout [rollout].
        columns: Columns given so far.
        pose: Poses of past columns [rollout, row, place, 3].
        visible: Who could be seen in them, as the same agent [rollout, row, place].
        features: Normed features of them before each block [block, rollout, row, place, D].
    """

    roads: RoadFeatures
    scene: Tensor
    columns: int
    pose: Tensor
    visible: Tensor
    features: Tensor

    @property
    def window(self) -> int:
        """Past columns that are kept."""
        return self.visible.shape[2]

    def last(self) -> tuple[Tensor, Tensor]:
        """Pose and visibility of every row in the last column."""
        place = (self.columns - 1) % self.window
        return self.pose[:, :, place], self.visible[:, :, place]


@dataclass(frozen=True, slots=True)
class Entries:
    """One half second as the entry stage sees it.

    Attributes:
        token: The half second.
        rollout: Rollouts that still ask for newcomers, by their place in the batch.
        map: Encoded maps.
        scene: Map of each of those rollouts.
        before: Poses [rollout, row, 3] half a second earlier ...
        known: ... and who was seen then [rollout, row].
        column: The agents so far.
        raw: Normed embeddings of all rows, zero where nobody is [rollout, row, D].
        relation: How all rows stand to the ego [rollout, row, D].
        within: Which of them the ego's query sees [rollout, row].
        roads: Road tokens around the ego.
        ground: Features of the cells around it, if they are told from them
            [rollout, cell, C].
    """

    token: int
    rollout: Tensor
    map: RoadFeatures
    scene: Tensor
    before: Tensor
    known: Tensor
    column: Column
    raw: Tensor
    relation: Tensor
    within: Tensor
    roads: Seen
    ground: Tensor | None

    def take(self, places: Int64[Tensor, " kept"]) -> "Entries":
        """Go on with some of the rollouts only: nothing more is computed for the others."""
        return replace(
            self,
            rollout=self.rollout[places],
            scene=self.scene[places],
            before=self.before[places],
            known=self.known[places],
            column=self.column.take(places),
            raw=self.raw[places],
            relation=self.relation[places],
            within=self.within[places],
            roads=self.roads.take(places),
            ground=None if self.ground is None else self.ground[places],
        )


@dataclass(frozen=True, slots=True)
class _Asking:
    """What asks for newcomers, and how it sees."""

    cells: CellStack
    details: DetailStack
    cell_roads: Reach
    cell_agents: Reach
    detail_roads: Reach
    detail_agents: Reach

    @classmethod
    def of(cls, cells: CellStack, details: DetailStack) -> "_Asking":
        return cls(
            cells,
            details,
            cells.roads_reach(),
            cells.agents_reach(0),
            details.roads_reach(),
            details.agents_reach(),
        )


class Stepper:
    """A network ready to be played: in evaluation mode, its tables made once.

    A network without a life cycle has no ``entry_`` methods: they raise ``ValueError``.
    """

    @torch.no_grad()
    def __init__(self, network: Network) -> None:
        self.network = network.eval()
        self._tables = network.embed.tables()
        self._past_table = network.motion.past_relation.table()
        self._shapes = network.motion.move_shapes()
        self._roads_reach = network.motion.roads_reach()
        self._agents_reach = network.motion.agents_reach()
        self._asking: _Asking | None = None
        if network.cells is not None and network.details is not None:
            self._asking = _Asking.of(network.cells, network.details)

    @property
    def insertion_and_removal(self) -> bool:
        """Whether agents can enter; if not, the network knows motion only."""
        return self._asking is not None

    @property
    def leaves(self) -> bool:
        """Whether the network says who leaves."""
        return self.network.motion.leave is not None

    @torch.no_grad()
    def begin(self, roads: Roads, scene: Int64[Tensor, " rollout"], rows: int) -> Memory:
        """Encode maps and start with an empty past.

        Args:
            roads: Map of each scene (``batch.collate_roads(records, max_map_tokens)``).
            scene: Which of those scenes each rollout plays.
            rows: Places for agents.
        """
        settings = self.network.settings
        shape = (len(scene), rows, settings.temporal_window_tokens)
        pose = torch.zeros((*shape, 3), device=scene.device)
        features = pose.new_zeros((settings.motion_blocks, *shape, settings.width))
        return Memory(
            roads=self.network.roads(roads, self.network.roads.look(roads)),
            scene=scene,
            columns=0,
            pose=pose,
            visible=torch.zeros(shape, dtype=torch.bool, device=scene.device),
            features=features,
        )

    @torch.no_grad()
    def motion_step(self, memory: Memory, column: Column) -> MotionStep:
        """Append a column to the past and say what follows it. Once per column."""
        motion = self.network.motion
        visible = column.visible
        rows = Rows.where(visible)
        memory.visible &= (column.presence != Presence.INSERTED)[..., None]
        x = self._embed(*memory.last(), column, rows)
        sight = self._sight(memory, column, rows)
        x = x if sight.light is None else x + sight.light
        place = memory.columns % memory.window
        for block, past in zip(motion.blocks, memory.features, strict=True):
            before = normed(x)
            own = Seen.own(rows.pack(past), sight.past_relation, sight.past_present)
            x = block(x, own, sight)
            past[:, :, place] = rows.spread(before)
        memory.pose[:, :, place] = column.pose
        memory.visible[:, :, place] = visible
        memory.columns += 1
        return MotionStep(motion.foretell(rows, x, rows.pack(column.kind), self._shapes))

    @torch.no_grad()
    def entry_begin(self, memory: Memory, column: Column) -> Entries:
        """Look at the map and the agents around the ego, before any newcomer.

        ``column`` must not have been given to ``motion_step`` yet.
        """
        rollouts, rows = column.presence.shape
        raw = memory.features.new_zeros((rollouts, rows, memory.features.shape[-1]))
        ego_pose = column.pose[:, EGO, None]
        each = torch.arange(rollouts, device=raw.device)
        roads = see_roads(
            self._asked().cell_roads,
            Rows(each, each[:, None]),
            ego_pose,
            memory.roads,
            memory.scene,
        )
        within = torch.zeros_like(column.observed)
        nobody = replace(
            column, presence=torch.zeros_like(column.presence), observed=within
        )
        before, known = memory.last()
        empty = Entries(
            token=memory.columns,
            rollout=each,
            map=memory.roads,
            scene=memory.scene,
            before=before,
            known=known,
            column=nobody,
            raw=raw,
            relation=torch.zeros_like(raw),
            within=within,
            roads=roads,
            ground=None,
        )
        entries = self.entry_add(empty, column)
        return replace(entries, ground=self._ground(entries))

    @torch.no_grad()
    def entry_add(self, entries: Entries, column: Column) -> Entries:
        """Go on with newcomers as further visible rows of the same column."""
        fresh = Rows.where(column.visible & ~entries.column.visible)
        came = fresh.spread(torch.ones(len(fresh.at), device=fresh.at.device)) > 0
        embedded = self._embed(entries.before, entries.known, column, fresh)
        raw = fresh.spread(normed(embedded))
        ego_pose = column.pose[:, EGO, None].expand_as(column.pose)
        described = relations(fresh.pack(ego_pose), fresh.pack(column.pose)[:, None])
        reach = self._asked().cell_agents
        related = reach.relation.look_up(described, reach.table)[:, 0]
        within = came & within_radius(ego_pose, column.pose, reach.radius_m)
        return replace(
            entries,
            column=column,
            raw=torch.where(came[..., None], raw, entries.raw),
            relation=torch.where(came[..., None], fresh.spread(related), entries.relation),
            within=entries.within | within,
        )

    @torch.no_grad()
    def entry_query(self, entries: Entries) -> EntryQuery:
        """Ask for the next newcomer of every rollout."""
        cells = self._asked().cells
        occupied = cells.occupied(entries.column.cell, entries.within)
        relation = Shared.of(entries.relation)
        agents = Seen.own(entries.raw, relation, entries.within)
        x = cells(occupied[:, None], entries.roads, agents)[:, 0]
        each = torch.arange(len(x), device=x.device)
        said = cells.answer(Rows(each, each), x[:, None], entries.ground)
        return EntryQuery(
            said.add_logit[:, 0],
            None if said.cell_logits is None else said.cell_logits[:, 0],
            None if said.place_m is None else said.place_m[:, 0],
        )

    @torch.no_grad()
    def entry_details(
        self,
        entries: Entries,
        cell: Int64[Tensor, " rollout"],
        place_m: Float32[Tensor, "rollout 2"] | None = None,
    ) -> EntryDetails:
        """Ask who enters at a cell of every rollout.

        Args:
            entries: The half second.
            cell: The cells.
            place_m: Where in them, in the ego's grid frame; their centres if None.
        """
        asking, column = self._asked(), entries.column
        details = asking.details
        place_m = details.centre_m[cell] if place_m is None else place_m
        pose = cell_pose(column.pose[:, EGO], place_m)[:, None]
        each = torch.arange(len(cell), device=cell.device)
        rows = Rows(each, each[:, None])
        source = torch.arange(column.presence.numel(), device=cell.device)
        around = look_around(
            asking.detail_agents,
            rows,
            pose,
            column.pose,
            source.view_as(column.presence),
            column.visible[:, None],
        )
        roads = see_roads(asking.detail_roads, rows, pose, entries.map, entries.scene)
        x = details(cell, roads, around.seen(entries.raw.flatten(0, 1)))
        kinds = torch.arange(details.given_kind.num_embeddings, device=cell.device)
        near = Lying.near(entries.map, roads)
        said = details.answer(rows, x[:, None], kinds, pose[:, 0], near)
        return EntryDetails(
            said.kind_logits[:, 0],
            said.size_log_m.exp(),
            said.heading_logits,
            said.turned_rad,
            said.offset_m,
        )

    def _ground(self, entries: Entries) -> Tensor | None:
        """Describe the cells around every ego, before any newcomer."""
        ground, column = self._asked().cells.ground, entries.column
        if ground is None:
            return None
        row = torch.arange(column.presence.numel(), device=column.pose.device)
        there = column.visible & (column.presence != Presence.INSERTED)
        features = entries.raw.flatten(0, 1)
        lying = Lying(features, row.view_as(column.presence), column.pose, there)
        roads = Lying.roads(entries.map, entries.scene)
        described: Tensor = ground(column.pose[:, EGO], roads, lying)
        return described

    def _asked(self) -> _Asking:
        if self._asking is None:
            raise ValueError(
                "these weights know motion only (model.insertion_and_removal is false): "
                "nobody can enter"
            )
        return self._asking

    def _embed(self, before: Tensor, known: Tensor, column: Column, rows: Rows) -> Tensor:
        """Embed some rows of a column, given where who was known to be before it."""
        agents = AgentRows(
            kind=rows.pack(column.kind),
            size_lwh_m=rows.pack(column.size_lwh_m),
            pose=rows.pack(column.pose),
            before=rows.pack(before),
            known=rows.pack(known),
            move=rows.pack(column.move),
            presence=rows.pack(column.presence),
            cell=rows.pack(column.cell),
            ego=rows.at % column.cell.shape[-1] == EGO,
        )
        embedded: Tensor = self.network.embed(agents, self._tables)
        return embedded

    def _sight(self, memory: Memory, column: Column, rows: Rows) -> Sight:
        """What the visible rows of a column see."""
        visible = column.visible
        others = ~torch.eye(visible.shape[1], dtype=torch.bool, device=visible.device)
        around = look_around(
            self._agents_reach,
            rows,
            column.pose,
            column.pose,
            rows.number,
            visible[:, None] & visible[:, :, None] & others,
        )
        pose, token = rows.pack(column.pose), torch.full_like(rows.at, memory.columns)
        scene = memory.scene[rows.at // visible.shape[1]]
        light = self.network.motion.lights_ahead(memory.roads, pose, scene, token)
        roads = see_roads(
            self._roads_reach, rows, column.pose, memory.roads, memory.scene, token
        )
        place = torch.arange(memory.window, device=visible.device)
        ago = (place - memory.columns) % memory.window - memory.window  # -window ... -1
        described = relations(pose, rows.pack(memory.pose))
        ago = ago.to(described.dtype).expand(len(rows.at), -1)[..., None]
        related = self.network.motion.past_relation.look_up(
            torch.cat([described, ago], dim=-1), self._past_table
        )
        past = rows.pack(memory.visible)
        return Sight(Shared.of(related), past, roads, around, light)
