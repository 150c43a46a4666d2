"""Insertions of one token step of many rollouts: the part of the stepper that inserts."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.agent_embedding import AgentRows
from infgen.model.insertion.agent_spacing import SpacedAgents, swept
from infgen.model.insertion.cell_features import CellSources
from infgen.model.insertion.cell_query import CellStack
from infgen.model.insertion.detail_query import (
    DetailQuery,
    DetailStack,
    InsertionDetails,
)
from infgen.model.insertion.placement_features import Places
from infgen.model.layers import full_precision, normed
from infgen.model.long_memory import Standing, standing_after
from infgen.model.neighbours import (
    NeighbourSpec,
    cell_pose,
    find_map_neighbours,
    find_neighbours,
)
from infgen.model.network import Network
from infgen.model.relations import Rows, within_radius
from infgen.model.rotary.turns import turned, turned_back
from infgen.model.step_memory import Insertions, StepMemory
from infgen.model.token_step import PositionOutputs, TokenStep
from infgen.tokens.scene_tokens import EGO, Presence


@dataclass(frozen=True, slots=True)
class InsertionBlocks:
    """Query blocks of insertion with their neighbour specifications."""

    cells: CellStack
    details: DetailStack
    cell_roads: NeighbourSpec
    cell_agents: NeighbourSpec
    detail_roads: NeighbourSpec
    detail_agents: NeighbourSpec

    @classmethod
    def of(cls, cells: CellStack, details: DetailStack) -> "InsertionBlocks":
        """Evaluate the tables of their relations for one pass."""
        return cls(
            cells,
            details,
            cells.map_reach(),
            cells.agents_reach(0),
            details.map_reach(),
            details.agents_reach(),
        )


class InsertionStepper:
    """A network in evaluation mode, queried for the insertions of one token step at a time.

    Without insertion, its ``entry_`` methods raise ``ValueError``.
    """

    @torch.no_grad()
    def __init__(self, network: Network) -> None:
        self.network = network.eval()
        self._tables = network.embed.tables()
        self._asking: InsertionBlocks | None = None
        if network.cells is not None and network.details is not None:
            self._asking = InsertionBlocks.of(network.cells, network.details)

    @property
    def insertion_and_removal(self) -> bool:
        """Whether agents can enter; if not, the network knows motion only."""
        return self._asking is not None

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
        empty_step = replace(
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
            token_step=empty_step,
            raw=raw,
            relation=raw.new_zeros(
                (rollouts, places, self.network.settings.relation_features)
            ),
            within=within,
            roads=roads,
            ego=None,
            cell_features=None,
            spacing=self._no_spacing(rollouts, raw),
        )
        entries = self.entry_add(empty, token_step, rows)
        return replace(
            entries, ego=self._ego(entries), cell_features=self._cell_features(entries)
        )

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
        agents = agent_rows(*before, standing, token_step, fresh)
        embedded = normed(self._embed(agents))
        if entries.spacing is not None:
            self._add_spacing(entries.spacing, token_step, agents, embedded, fresh.at, real)
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
        ego = None if entries.ego is None else entries.active(entries.ego)
        x = cells(occupied[:, None], roads, agents, average, ego)[:, 0]
        each = torch.arange(len(x), device=x.device)
        rows, queries = Rows(each, each), x[:, None].float()
        with full_precision(x):
            spaced = None
            if cells.spacing is not None and entries.spacing is not None:
                spaced = cells.spacing.choose(queries, entries.active(entries.spacing))
            said = cells.answer(rows, queries, cell_features, spaced)
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
        beside = None
        if details.spacing is not None:
            pose_of, size_lw_m = swept(
                token_step.pose, token_step.size_lwh_m[..., :2], entries.step_m()
            )
            of_each = each[:, None], around.place
            beside = SpacedAgents(
                self._raw(entries),
                around.index,
                entries.active(pose_of)[of_each],
                entries.active(size_lw_m)[of_each],
                around.present,
            )
        places = None
        if details.placement is not None:
            places = Places.on(entries.map, pose[:, 0], entries.active(entries.scene))
        query = DetailQuery(details, x, pose[:, 0], near, beside, places)
        return InsertionDetails(
            said.agent_type_logits[:, 0],
            said.size_log_m.exp(),
            said.heading_logits,
            said.turned_rad,
            said.offset_m,
            query if sampled else None,
        )

    def _ego(self, entries: Insertions) -> Tensor | None:
        """Describe every ego [rollout, D], if that is used."""
        asking = self._asked()
        if asking.cells.ego is None:
            return None
        turn = asking.cell_agents.relation.turn(entries.token_step.pose[:, EGO])
        described: Tensor = asking.cells.ego(turned_back(entries.raw[:, EGO], turn))
        return described

    def _cell_features(self, entries: Insertions) -> Tensor | None:
        """Describe the cells around every ego, before any inserted agent."""
        cell_features, token_step = self._asked().cells.cell_features, entries.token_step
        if cell_features is None:
            return None
        row = torch.arange(token_step.presence.numel(), device=token_step.pose.device)
        there = token_step.visible & (token_step.presence != int(Presence.INSERTED))
        lying = CellSources(
            self._raw(entries), row.view_as(token_step.presence), token_step.pose, there
        )
        roads = CellSources.roads(entries.map, entries.scene)
        described: Tensor = cell_features(token_step.pose[:, EGO], roads, lying)
        return described

    def _no_spacing(self, rollouts: int, like: Tensor) -> Tensor | None:
        """Say nothing of the cells yet [rollout, cell + 1, C], if agents do."""
        spacing, cells = self._asked().cells.spacing, self._asked().cells.num_cells
        if spacing is None:
            return None
        return like.new_zeros((rollouts, cells + 1, spacing.agent.out_features))

    def _add_spacing(
        self,
        laid: Tensor,
        token_step: TokenStep,
        agents: AgentRows,
        features: Tensor,
        at: Tensor,
        real: Tensor | None,
    ) -> None:
        """Add what agents in the rows ``at`` say of the cells, in place."""
        spacing, rollout = self._asked().cells.spacing, at // token_step.presence.shape[1]
        assert spacing is not None
        cell, keys = spacing.around_each(
            token_step.pose[:, EGO][rollout],
            features,
            *swept(agents.pose, agents.size_lwh_m[:, :2], agents.moved()[0]),
        )
        keys = keys if real is None else keys * real[:, None, None]
        spacing.lay_out(rollout, cell, keys, laid)

    def _raw(self, entries: Insertions) -> Tensor:
        """Embeddings of all rows [row, D], not turned."""
        turn = self._asked().cell_agents.relation.turn(entries.token_step.pose)
        return turned_back(entries.raw, turn).flatten(0, 1)

    def _asked(self) -> InsertionBlocks:
        if self._asking is None:
            raise ValueError(
                "these weights know motion only (model.insertion_and_removal is false): "
                "it cannot insert agents"
            )
        return self._asking

    def _embed(self, agents: AgentRows) -> Tensor:
        embedded: Tensor = self.network.embed(agents, self._tables)
        return embedded


def agent_rows(
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
