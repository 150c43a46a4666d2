"""Agents as features: what each of them is and did last.

Shape letters as in ``layers``; rows are the visible agents of all tokens and scenes.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from infgen.model.features.approach import MovingPairs
from infgen.model.layers import FourierEmbedding, embedding_mlp, gather
from infgen.model.long_memory import Standing, StandingFeatures
from infgen.model.neighbours import NeighbourRows
from infgen.model.relations import direction
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

KINDS = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)

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

    def moved(self) -> tuple[Tensor, Tensor]:
        """Displacements in the last token step [row, 2], and where they are known [row]."""
        known = self.known & (self.presence != int(Presence.INSERTED))
        return (self.pose - self.before)[:, :2] * known[:, None], known

    def moving(self, around: NeighbourRows) -> MovingPairs:
        """Return how they move, and the others around each."""
        size_lw_m = self.size_lwh_m[:, :2]
        return MovingPairs(
            self.pose, *self.moved(), size_lw_m, around.index, around.present
        )


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
