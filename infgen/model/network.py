"""The whole network, and one pass over all tokens of a batch at once (training)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.clock import CLOCK
from infgen.model.agent_embedding import AgentEmbedding, AgentRows
from infgen.model.attention.neighbour_attention import Shared
from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.steps import poses_before
from infgen.model.device.index import BatchIndex
from infgen.model.device.together import launched_together
from infgen.model.features.anchors import AnchorHead
from infgen.model.features.approach import ApproachFeatures
from infgen.model.features.ego import EgoFeatures
from infgen.model.features.last_move import LastMoveHead
from infgen.model.features.over_edge import OverEdgeHead
from infgen.model.features.removal import EgoPlace, RemovalFeatures
from infgen.model.insertion.agent_spacing import AgentSpacing
from infgen.model.insertion.batch_pass import detail_outputs, insertion_outputs
from infgen.model.insertion.cell_query import CellStack
from infgen.model.insertion.cell_refinement import CellRefinement
from infgen.model.insertion.detail_features import OffsetEmbedding, OffsetFeatures
from infgen.model.insertion.detail_query import DetailStack
from infgen.model.insertion.placement_features import PlacementFeatures
from infgen.model.latent_rates import LatentRates
from infgen.model.layers import initialise, normed
from infgen.model.logits import MapOutputs, MotionOutputs, Outputs
from infgen.model.long_memory import (
    Density,
    DensityFeatures,
    Standing,
    StandingFeatures,
    averages_before,
    count_around,
    moves_between,
    standing_at,
)
from infgen.model.map import MapEncoder
from infgen.model.motion_stack import AgentContext, MotionStack
from infgen.model.neighbours import MapFeatures, find_map_neighbours, find_others
from infgen.model.relations import Rows, describe_pairs
from infgen.model.rotary.turns import turned
from infgen.model.settings import ModelSettings
from infgen.tokens.grid import Grid, make_grid
from infgen.tokens.scene_tokens import EGO, Presence
from infgen.tokens.settings import TokenSettings
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

SceneFeatures = DensityFeatures | EgoFeatures
AgentFeatures = SceneFeatures | StandingFeatures | RemovalFeatures | ApproachFeatures
MotionParts = AgentFeatures | AnchorHead | LastMoveHead | OverEdgeHead
CellParts = CellRefinement | AgentSpacing
DetailParts = OffsetEmbedding | OffsetFeatures | PlacementFeatures
AddedPart = MotionParts | CellParts | DetailParts | LatentRates
"""Parts that may be added to trained weights."""


class Network(nn.Module):
    """Roads, agents and inserted agents in one network (SPEC 4).

    It carries its vocabularies, so weights on disk need nothing beside them.
    """

    def __init__(
        self,
        settings: ModelSettings,
        motion: MotionVocabulary,
        roads: MapVocabulary,
        grid: TokenSettings,
    ) -> None:
        super().__init__()
        self.settings = settings
        self.grid_settings = grid
        cells = make_grid(grid)
        for name, array in (
            ("motion_size_lw_m", motion.size_lw_m),
            ("motion_path", motion.path),
            ("motion_real", motion.real),
            ("road_curve_m", roads.curve_m),
            ("road_real", roads.real),
        ):
            self.register_buffer(name, torch.from_numpy(array.copy()))
        self.roads = MapEncoder(settings, roads)
        self.embed = AgentEmbedding(settings, motion, cells)
        self.motion = MotionStack(settings, motion, CLOCK.token_s)
        inserts = settings.insertion_and_removal
        self.cells = CellStack(settings, cells) if inserts else None
        self.details = DetailStack(settings, cells) if inserts else None
        self.rates = LatentRates() if inserts and settings.latent_rates else None
        self.apply(initialise)
        for part in self.added_parts().values():
            part.begin_at_zero()

    @property
    def grid(self) -> Grid:
        """Grid of cells and heading bins."""
        return make_grid(self.grid_settings)

    def added_parts(self) -> dict[str, AddedPart]:
        """Return the parts, by name, that may be added to trained weights.

        Before they are trained they change no logit, and offset bins are equally likely.
        """
        return {
            name: part for name, part in self.named_modules() if isinstance(part, AddedPart)
        }

    def motion_vocabulary(self) -> MotionVocabulary:
        """Return the motion tokens that motion logits choose from."""
        names = ("motion_size_lw_m", "motion_path", "motion_real")
        return MotionVocabulary(*(self.get_buffer(n).numpy(force=True) for n in names))

    def map_vocabulary(self) -> MapVocabulary:
        """Return the shapes of map tokens."""
        names = ("road_curve_m", "road_real")
        return MapVocabulary(*(self.get_buffer(n).numpy(force=True) for n in names))

    def forward(
        self,
        batch: Batch,
        *,
        hidden_roads: bool = False,
        index: BatchIndex | None = None,
        insertions: bool = True,
    ) -> Outputs:
        """Compute all logits, every token given the true ones before it.

        Args:
            batch: The scenes.
            hidden_roads: Also predict hidden map tokens. While training, everyone sees the
                features of the pass that hides them, as a kind of dropout; otherwise they
                are predicted in a pass of their own.
            index: Which places of the batch hold something, if that is known already.
            insertions: Also predict who is inserted.
        """
        with launched_together(
            self, together=self.training and batch.agents.pose.device.type != "cpu"
        ):
            return self._outputs(batch, hidden_roads, index, insertions)

    def _outputs(
        self,
        batch: Batch,
        hidden_roads: bool,
        index: BatchIndex | None,
        insertions: bool,
    ) -> Outputs:
        of_map = None if index is None else index.roads
        sight = self.roads.look(batch.roads, of_map)
        covered = sight.covered(batch.roads) if hidden_roads else sight
        roads = self.roads(batch.roads, covered if self.training else sight)
        agents = batch.agents
        rows = Rows.where(agents.visible) if index is None else index.visible
        asked = Rows.where(batch.entries.asked) if index is None else index.asked
        told = Rows.where(batch.details.present) if index is None else index.described
        standing = None
        if self.settings.standing_features:
            standing = _standing(agents).take(rows.at)
        given = _agent_rows(agents, rows, standing)
        x = self.embed(given, self.embed.tables())
        raw, cells, details = normed(x), self.cells, self.details
        shown = turned(raw, self.motion.agents_relation.turn(given.pose))
        hidden = None
        if hidden_roads:
            known = roads if self.training else self.roads(batch.roads, covered)
            hidden = self.roads.predict_hidden(batch.roads, known, of_map)
        density = self._density(agents)
        as_logged = index is not None  # Rows are never taken over in logs.
        return Outputs(
            motion=self._motion(agents, rows, given, x, roads, density, as_logged),
            entries=None
            if cells is None or not insertions
            else insertion_outputs(cells, batch, asked, rows, raw, shown, roads, density),
            details=None
            if details is None or not insertions
            else detail_outputs(details, batch, told, rows, raw, shown, roads),
            roads=None if hidden is None else MapOutputs(*hidden),
            rates=None if self.rates is None else self.rates(),
        )

    def _density(self, agents: Agents) -> Density | None:
        """Count the agents around the ego [scene, token], if that is used."""
        settings = self.settings
        if not settings.density_features:
            return None
        ego_pose, radius_m = agents.pose[:, :, EGO], settings.position_query_radius_m
        count = count_around(ego_pose, agents.pose, agents.visible, radius_m)
        return Density(count, averages_before(count))

    def _motion(
        self,
        agents: Agents,
        rows: Rows,
        given: AgentRows,
        x: Tensor,
        roads: MapFeatures,
        density: Density | None,
        as_logged: bool,
    ) -> MotionOutputs:
        """Run the motion stack over the visible agents of all tokens."""
        visible, agent_type = agents.visible, agents.agent_type
        scene = torch.arange(len(agent_type), device=agent_type.device)
        by_scene = Rows(rows.at, rows.number.flatten(1))
        by_token = Rows(rows.at, rows.number.flatten(0, 1))
        pose = agents.pose.flatten(0, 1)  # [scene token, agent, 3]
        visible = visible.flatten(0, 1)
        past_index, past_present, past_relation = self._past(agents, rows, as_logged)
        _, tokens, places = agents.visible.shape
        reach, token = self.motion.map_reach(), rows.at // places % tokens
        around = find_others(self.motion.agents_reach(), by_token, pose, visible)
        moving = self.motion.moving(given, around)
        of_row = rows.at // agents.visible[0].numel()
        edges = self.motion.edges_near(given, roads, of_row)
        sight = AgentContext(
            past_relation,
            past_present,
            self.motion.past_relation.turn(given.pose, token),
            find_map_neighbours(
                reach, by_scene, agents.pose.flatten(1, 2), roads, scene, token
            ),
            around,
            moving,
            edges,
            self.motion.inserted_over_edge(given, edges),
            self.motion.last_move(given),
            self.motion.added(given.pose, moving, roads, of_row, token),
            None if density is None else density.take(rows.at // visible.shape[1]),
            _ego_place(agents, rows) if self.motion.ego_place is not None else None,
            self.motion.ego_told(x, rows, agents.visible),
        )
        x = self.motion(x, past_index, sight)
        agent_type = rows.pack(agents.agent_type[:, None].expand(agents.visible.shape))
        shapes = self.motion.motion_features()
        return self.motion.foretell(rows, x, agent_type, shapes, sight)

    def _past(
        self, agents: Agents, rows: Rows, as_logged: bool
    ) -> tuple[Tensor, Tensor, Shared]:
        """Rows, presence and relations of every row's own past, oldest first [N, K]."""
        window = self.settings.temporal_window_tokens

        def past(values: Tensor) -> Tensor:
            padded = functional.pad(values, (0, 0, window, 0))  # [scene, token, agent]
            return rows.pack(padded.unfold(1, window, 1)[:, :-1])

        index, present = past(rows.number), past(agents.visible)
        if not as_logged:  # Who is inserted has no past, even if the row had another's.
            inserted = agents.presence == int(Presence.INSERTED)
            life = inserted.cumsum(dim=1)
            present &= past(life) == rows.pack(life)[:, None]
        pose = rows.pack(agents.pose)
        ago = torch.arange(-window, 0, device=pose.device, dtype=pose.dtype)
        ago = ago.expand(len(index), window)
        relation = self.motion.past_relation
        told = describe_pairs(relation, relation.table(), pose, pose[index], ago=ago)
        return index, present, Shared.of(told)


def _standing(agents: Agents) -> Standing:
    """For how long all agents have stood [scene, token, agent]."""
    before, known = poses_before(agents)
    moves = moves_between(before, known, agents.pose, agents.presence)
    return standing_at(agents.presence, moves & agents.visible)


def _ego_place(agents: Agents, rows: Rows) -> EgoPlace:
    """Where all visible agents are to their ego."""
    before, known = poses_before(agents)
    known = known & (agents.presence != int(Presence.INSERTED))
    ego = rows.at // agents.visible.shape[2]
    return EgoPlace(
        rows.pack(agents.pose),
        agents.pose[:, :, EGO].flatten(0, 1)[ego],
        rows.pack(before),
        before[:, :, EGO].flatten(0, 1)[ego],
        rows.pack(known),
    )


def _agent_rows(agents: Agents, rows: Rows, standing: Standing | None) -> AgentRows:
    """All visible agents, with where they were one token step earlier."""
    before, known = poses_before(agents)
    pose, visible = agents.pose, agents.visible
    tokens = pose.shape[1]
    return AgentRows(
        agent_type=rows.pack(agents.agent_type[:, None].expand(-1, tokens, -1)),
        size_lwh_m=rows.pack(agents.size_lwh_m[:, None].expand(-1, tokens, -1, -1)),
        pose=rows.pack(pose),
        before=rows.pack(before),
        known=rows.pack(known),
        motion_token=rows.pack(agents.motion_token),
        presence=rows.pack(agents.presence),
        cell=rows.pack(agents.cell),
        ego=rows.at % visible.shape[-1] == EGO,
        standing=standing,
    )
