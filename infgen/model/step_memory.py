"""State of the stepper between token steps, and within one."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int64
from torch import Tensor
from torch.nn.functional import pad

from infgen.model.attention.neighbour_attention import Shared
from infgen.model.layers import AttentionSources
from infgen.model.long_memory import AVERAGED_TOKENS, Standing, next_averages
from infgen.model.neighbours import MapFeatures
from infgen.model.rotary.turns import multiples, turn_of, turned
from infgen.model.settings import ModelSettings
from infgen.model.token_step import TokenStep
from infgen.tokens.scene_tokens import Presence


@dataclass(slots=True)
class StepMemory:
    """What the past leaves behind. ``motion_step`` writes into it.

    The ring holds the last ``window`` columns; column c is at place c modulo window.

    Attributes:
        roads: Encoded maps, one per scene.
        scene: Map of each rollout [rollout].
        columns: Columns given so far.
        begun: Column that is the first of each rollout's own [rollout]: 0, but for
            rollouts that took the place of others.
        pose: Poses of past columns [rollout, row, place, 3].
        visible: Rows visible in them, with the same agent as now [rollout, row, place].
        features: Normed features of them before each block, turned by their headings and
            columns if features are [block, rollout, row, place, D].
        rotary: Whether they are.
        average: Moving averages of the number of agents around egos [rollout, constant].
        standing: For how long agents have stood [rollout, row], if that is used.
    """

    roads: MapFeatures
    scene: Tensor
    columns: int
    begun: Tensor
    pose: Tensor
    visible: Tensor
    features: Tensor
    rotary: bool
    average: Tensor
    standing: Standing | None

    @classmethod
    def empty(
        cls, maps: MapFeatures, scene: Tensor, rows: int, settings: ModelSettings
    ) -> "StepMemory":
        """Start without a past on the maps [rollout] of ``scene``."""
        shape = (len(scene), rows, settings.temporal_window_tokens)
        pose = torch.zeros((*shape, 3), device=scene.device)
        visible = torch.zeros(shape, dtype=torch.bool, device=scene.device)
        return cls(
            roads=maps,
            scene=scene,
            columns=0,
            begun=torch.zeros_like(scene),
            pose=pose,
            visible=visible,
            features=pose.new_zeros((settings.motion_blocks, *shape, settings.width)),
            rotary=settings.relations == "rotary",
            average=pose.new_zeros((len(scene), len(AVERAGED_TOKENS))),
            standing=Standing.unknown(visible[:, :, 0])
            if settings.standing_features
            else None,
        )

    @property
    def window(self) -> int:
        """Past columns that are kept."""
        return self.visible.shape[2]

    def last(self) -> tuple[Tensor, Tensor]:
        """Pose and visibility of every row in the last column."""
        place = (self.columns - 1) % self.window
        return self.pose[:, :, place], self.visible[:, :, place]

    def averages_before(self, count: Tensor) -> Tensor:
        """Averages before a column [rollout, constant], given its own numbers [rollout].

        A rollout's first column has nothing before it: there they are its own.
        """
        first = self.columns <= self.begun
        return torch.where(first[:, None], count[:, None], self.average)

    def count(self, count: Tensor) -> None:
        """Update the averages by the numbers of a column [rollout]."""
        self.average = next_averages(self.average, count, self.columns <= self.begun)

    def put(self, rollouts: Int64[Tensor, " replaced"], others: "StepMemory") -> None:
        """Replace some rollouts by others, whose last columns become the last ones here.

        Args:
            rollouts: Which.
            others: As many rollouts, with as many rows and as long a window.
        """
        turn = (self.columns - others.columns) % self.window
        self.scene[rollouts] = others.scene
        self.begun[rollouts] = self.columns - others.columns
        self.pose[rollouts] = others.pose.roll(turn, dims=2)
        self.visible[rollouts] = others.visible.roll(turn, dims=2)
        self.features[:, rollouts] = self._at_own_times(others).roll(turn, dims=3)
        self.average[rollouts] = others.average
        if self.standing is not None and others.standing is not None:
            self.standing.put(rollouts, others.standing)

    def _at_own_times(self, others: "StepMemory") -> Tensor:
        """Features of others, turned as if their last columns were the last ones here."""
        if not self.rotary:
            return others.features
        later, features = float(self.columns - others.columns), others.features
        still = features.new_zeros(3, dtype=torch.float32)
        of_each = multiples(features.shape[-1]).to(still.device)
        return turned(features, turn_of(still, of_each, later))

    def with_rows(self, rows: int) -> "StepMemory":
        """Append free rows, up to so many."""
        more = rows - self.visible.shape[1]
        return replace(
            self,
            pose=pad(self.pose, (0, 0, 0, 0, 0, more)),
            visible=pad(self.visible, (0, 0, 0, more)),
            features=pad(self.features, (0, 0, 0, 0, 0, more)),
            standing=None if self.standing is None else self.standing.with_rows(more),
        )


@dataclass(frozen=True, slots=True)
class Insertions:
    """One token step as the entry stage sees it.

    ``Stepper.entry_add`` writes into ``raw``, ``relation`` and ``spacing``. All but
    ``rollout`` is of every rollout of the batch: what is large is taken only when it is
    looked at.

    Attributes:
        token: The token step.
        rollout: Rollouts whose insertion turns go on, by their index in the batch, in
            order [active]; one that is queried at several cells is named as often.
        map: Encoded maps.
        scene: Map of each rollout.
        before: Poses [rollout, row, 3] one token step earlier ...
        known: ... and rows observed then [rollout, row].
        average: Moving averages of the number of agents before the token step
            [rollout, constant].
        standing: For how long the agents had stood before it [rollout, row], if that is
            used.
        token_step: The agents so far.
        raw: Normed embeddings of all rows, turned by their headings if features are, zero
            in free rows [rollout, row, D].
        relation: How all rows stand to the ego [rollout, row, R].
        within: Which of them the ego's query sees [rollout, row].
        roads: Map tokens around the ego.
        ego: What cell queries are told of the ego, if that is used [rollout, D].
        cell_features: Features of the cells around it, if they are used
            [rollout, cell, C].
        spacing: What the agents so far say of them, and of no cell, by the gaps between, if
            that is used [rollout, cell + 1, C].
        all_active: Whether every rollout of the batch goes on, each once.
    """

    token: int
    rollout: Tensor
    map: MapFeatures
    scene: Tensor
    before: Tensor
    known: Tensor
    average: Tensor
    standing: Standing | None
    token_step: TokenStep
    raw: Tensor
    relation: Tensor
    within: Tensor
    roads: AttentionSources
    ego: Tensor | None
    cell_features: Tensor | None
    spacing: Tensor | None
    all_active: bool = True

    def take(self, places: Int64[Tensor, " kept"]) -> "Insertions":
        """Go on with some of the rollouts only, each as often as it is named.

        Nothing more is computed for the others.
        """
        return replace(self, rollout=self.rollout[places], all_active=False)

    def active(self, values: Tensor) -> Tensor:
        """Take the values [rollout, ...] of the rollouts that go on."""
        return values if self.all_active else values[self.rollout]

    def rows(self) -> Int64[Tensor, "active row"]:
        """Flat indices of the rows of the rollouts that go on."""
        rows = self.within.shape[1]
        row = torch.arange(rows, device=self.rollout.device)
        return self.rollout[:, None] * rows + row

    def step_m(self) -> Tensor:
        """Displacements in the last token step [rollout, row, 2]; zero if not known."""
        known = self.known & (self.token_step.presence != int(Presence.INSERTED))
        return (self.token_step.pose - self.before)[..., :2] * known[..., None]

    def agents(self) -> AttentionSources:
        """Show every ego that goes on the agents around it."""
        relation = Shared.of(self.active(self.relation))
        within, turn = self.active(self.within), self.roads.turn  # The ego's, as of roads.
        turn = None if turn is None else self.active(turn)
        features = self.raw.flatten(0, 1)
        return AttentionSources(features, self.rows(), relation, within, turn)

    def around(self) -> tuple[AttentionSources, Tensor | None]:
        """Return the map tokens, and the features of cells, around these egos."""
        if self.all_active:
            return self.roads, self.cell_features
        cells = self.cell_features
        return (
            self.roads.take(self.rollout),
            None if cells is None else cells[self.rollout],
        )
