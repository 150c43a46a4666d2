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
        column = (column with newcomers as rows: ENTERING, FIRST_MOVE, observed=False)
        entries = stepper.entry_add(entries, column)
    motion = stepper.motion_step(memory, column)     # next move, leaving next?

Dims: ``rollout`` is any mix of scenes and rollouts of them, ``row`` the places for agents.
Row 0 is always the ego. A row that is ABSENT costs nothing. A row that is ENTERING starts
with an empty past, so a freed row can be given to a newcomer as it is.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.agents import AgentRows, Sight
from infgen.model.batch import Roads
from infgen.model.layers import Seen, normed
from infgen.model.network import EGO, Network
from infgen.model.relations import Rows, relations, within_radius
from infgen.model.sight import RoadFeatures, cell_pose, look_around, see_roads
from infgen.tokens.scene_tokens import Presence


@dataclass(frozen=True, slots=True)
class Column:
    """All agents of all rollouts at the end of one half second.

    Attributes:
        kind: ``AgentKind``.
        size_lwh_m: Boxes.
        pose: Quantised x, y, heading (world frame of the scene).
        move: Move that led here, ``FIRST_MOVE`` where entering, else ``NO_MOVE``.
        presence: ``Presence``. LEAVING is the last column of an agent.
        observed: False where absent, unseen or entering (as ``SceneTokens.observed``).
        cell: Cell of the ego's grid that holds the agent, or ``NO_CELL``.
    """

    kind: Int64[Tensor, "rollout row"]
    size_lwh_m: Float32[Tensor, "rollout row 3"]
    pose: Float32[Tensor, "rollout row 3"]
    move: Int64[Tensor, "rollout row"]
    presence: Int64[Tensor, "rollout row"]
    observed: Bool[Tensor, "rollout row"]
    cell: Int64[Tensor, "rollout row"]

    @property
    def visible(self) -> Bool[Tensor, "rollout row"]:
        """Who can be seen: who is observed, or just entering."""
        return self.observed | (self.presence == Presence.ENTERING)


@dataclass(frozen=True, slots=True)
class MotionStep:
    """What follows a column; rows that are not visible hold zeros.

    Attributes:
        move_logits: Next move, by the row's own kind's codebook.
        leave_logit: Log-odds that the next token is the agent's last (LEAVING).
    """

    move_logits: Float32[Tensor, "rollout row move"]
    leave_logit: Float32[Tensor, "rollout row"]


@dataclass(frozen=True, slots=True)
class EntryQuery:
    """Whether one more agent enters at this column, and where.

    Attributes:
        add_logit: Log-odds of ADD against BEGIN MOTION.
        cell_logits: Cell of the ego's grid, given ADD.
    """

    add_logit: Float32[Tensor, " rollout"]
    cell_logits: Float32[Tensor, "rollout cell"]


@dataclass(frozen=True, slots=True)
class EntryDetails:
    """Who enters at a cell: sample a kind, then take that kind's row of the others.

    Attributes:
        kind_logits: ``AgentKind`` given the cell.
        size_lwh_m: Box, given the kind.
        heading_logits: Heading bin relative to the ego, given the kind.
        offset_m: Position less the cell's centre, in the ego's grid frame, given the kind.
    """

    kind_logits: Float32[Tensor, "rollout kind"]
    size_lwh_m: Float32[Tensor, "rollout kind 3"]
    heading_logits: Float32[Tensor, "rollout kind heading"]
    offset_m: Float32[Tensor, "rollout kind 2"]


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

    def keep(self, rollouts: Tensor) -> "Memory":
        """Go on with some rollouts only, given by their numbers."""
        return replace(
            self,
            scene=self.scene[rollouts],
            pose=self.pose[rollouts],
            visible=self.visible[rollouts],
            features=self.features[:, rollouts],
        )


@dataclass(frozen=True, slots=True)
class Entries:
    """One half second as the entry stage sees it.

    Attributes:
        memory: The past it follows.
        column: The agents so far.
        raw: Normed embeddings of all rows, zero where nobody is [rollout, row, D].
        relation: How all rows stand to the ego [rollout, row, D].
        within: Which of them the ego's query sees [rollout, row].
        roads: Road tokens around the ego.
    """

    memory: Memory
    column: Column
    raw: Tensor
    relation: Tensor
    within: Tensor
    roads: Seen


class Stepper:
    """A network ready to be played: in evaluation mode, its tables made once."""

    @torch.no_grad()
    def __init__(self, network: Network) -> None:
        self.network = network.eval()
        self._tables = network.embed.tables()
        self._past_table = network.motion.past_relation.table()
        self._roads_reach = network.motion.roads_reach()
        self._agents_reach = network.motion.agents_reach()
        self._cell_roads_reach = network.cells.roads_reach()
        self._cell_agents_reach = network.cells.agents_reach(0)
        self._detail_roads_reach = network.details.roads_reach()
        self._detail_agents_reach = network.details.agents_reach()

    @torch.no_grad()
    def begin(self, roads: Roads, scene: Int64[Tensor, " rollout"], rows: int) -> Memory:
        """Encode maps and start with an empty past.

        Args:
            roads: Map of each scene (``batch.collate_roads(records, max_roads)``).
            scene: Which of those scenes each rollout plays.
            rows: Places for agents.
        """
        settings = self.network.settings
        shape = (len(scene), rows, settings.window_tokens)
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
        memory.visible &= (column.presence != Presence.ENTERING)[..., None]
        x = self._embed(memory, column, rows)
        sight = self._sight(memory, column, rows)
        place = memory.columns % memory.window
        for block, past in zip(motion.blocks, memory.features, strict=True):
            before = normed(x)
            x = block(x, rows.pack(past), sight)
            past[:, :, place] = rows.spread(before)
        memory.pose[:, :, place] = column.pose
        memory.visible[:, :, place] = visible
        memory.columns += 1
        return MotionStep(rows.spread(motion.move(x)), rows.spread(motion.leave(x)[:, 0]))

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
            self._cell_roads_reach,
            Rows(each, each[:, None]),
            ego_pose,
            memory.roads,
            memory.scene,
        )
        within = torch.zeros_like(column.observed)
        nobody = replace(
            column, presence=torch.zeros_like(column.presence), observed=within
        )
        empty = Entries(memory, nobody, raw, torch.zeros_like(raw), within, roads)
        return self.entry_add(empty, column)

    @torch.no_grad()
    def entry_add(self, entries: Entries, column: Column) -> Entries:
        """Go on with newcomers as further visible rows of the same column."""
        fresh = Rows.where(column.visible & ~entries.column.visible)
        came = fresh.spread(torch.ones(len(fresh.at), device=fresh.at.device)) > 0
        raw = fresh.spread(normed(self._embed(entries.memory, column, fresh)))
        ego_pose = column.pose[:, EGO, None].expand_as(column.pose)
        described = relations(fresh.pack(ego_pose), fresh.pack(column.pose)[:, None])
        reach = self._cell_agents_reach
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
        cells = self.network.cells
        occupied = cells.occupied(entries.column.cell, entries.within)
        agents = Seen(entries.raw, entries.relation, entries.within)
        x = cells(occupied[:, None], entries.roads, agents)[:, 0]
        return EntryQuery(cells.add(x)[:, 0], cells.cell(x))

    @torch.no_grad()
    def entry_details(
        self, entries: Entries, cell: Int64[Tensor, " rollout"]
    ) -> EntryDetails:
        """Ask who enters at a cell of every rollout."""
        details, column = self.network.details, entries.column
        pose = cell_pose(column.pose[:, EGO], details.centre_m[cell])[:, None]
        each = torch.arange(len(cell), device=cell.device)
        rows = Rows(each, each[:, None])
        place = torch.arange(column.presence.numel(), device=cell.device)
        around = look_around(
            self._detail_agents_reach,
            rows,
            pose,
            column.pose,
            place.view_as(column.presence),
            column.visible[:, None],
        )
        roads = see_roads(
            self._detail_roads_reach, rows, pose, entries.memory.roads, entries.memory.scene
        )
        x = details(cell, roads, around.seen(entries.raw.flatten(0, 1)))
        kinds = torch.arange(details.given_kind.num_embeddings, device=cell.device)
        size_log_m, heading, offset_m = details.given(x[:, None], kinds)
        return EntryDetails(details.kind(x), size_log_m.exp(), heading, offset_m)

    def _embed(self, memory: Memory, column: Column, rows: Rows) -> Tensor:
        """Embed some rows of a column that follows the memory's last."""
        before, known = memory.last()
        agents = AgentRows(
            kind=rows.pack(column.kind),
            size_lwh_m=rows.pack(column.size_lwh_m),
            pose=rows.pack(column.pose),
            before=rows.pack(before),
            known=rows.pack(known),
            move=rows.pack(column.move),
            presence=rows.pack(column.presence),
            cell=rows.pack(column.cell),
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
        roads = see_roads(self._roads_reach, rows, column.pose, memory.roads, memory.scene)
        place = torch.arange(memory.window, device=visible.device)
        ago = (place - memory.columns) % memory.window - memory.window  # -window ... -1
        described = relations(rows.pack(column.pose), rows.pack(memory.pose))
        ago = ago.to(described.dtype).expand(len(rows.at), -1)[..., None]
        related = self.network.motion.past_relation.look_up(
            torch.cat([described, ago], dim=-1), self._past_table
        )
        return Sight(related, rows.pack(memory.visible), roads, around)
