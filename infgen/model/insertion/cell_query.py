"""Cell query: whether one more agent is inserted, and in which cell.

Shape letters as in ``layers``; S are the turns of inserted agents within one token step.
"""

import math

import torch
from torch import Tensor, nn

from infgen.model.features.ego import EgoFeatures
from infgen.model.insertion.agent_spacing import CellSpacing
from infgen.model.insertion.cell_features import CellFeatures
from infgen.model.insertion.query_block import QueryBlock
from infgen.model.layers import AttentionSources, mlp
from infgen.model.logits import InsertionOutputs
from infgen.model.long_memory import Density, DensityFeatures
from infgen.model.neighbours import NeighbourSpec
from infgen.model.relations import Rows, relation_embedding
from infgen.model.settings import ModelSettings
from infgen.tokens.grid import Grid


class CellStack(nn.Module):
    """Ask, from the ego's pose, whether one more agent enters and where (SPEC 4.6).

    Slots differ only by which inserted agents they see: as neighbours, and in the
        occupancy,
    which is one pooled embedding of all occupied cells (not one token per cell).
    """

    def __init__(self, settings: ModelSettings, grid: Grid) -> None:
        super().__init__()
        width = settings.width
        self.settings = settings
        self.num_cells = grid.num_cells
        self.radius_m = grid.radius_m
        self.query = nn.Embedding(1, width)
        self.occupancy = mlp(grid.num_cells, width, width)
        self.roads_relation = relation_embedding(settings.position_query_radius_m, settings)
        self.agents_relation = relation_embedding(
            settings.position_query_radius_m, settings
        )
        self.blocks = nn.ModuleList(
            QueryBlock(settings) for _ in range(settings.scene_blocks)
        )
        self.add = mlp(width, width, 1)
        by_cell = settings.position_token
        self.cell = mlp(width, width, grid.num_cells) if by_cell else None
        self.place = None if by_cell else mlp(width, width, 2)
        features = settings.cell_feature_width if by_cell else 0
        refined = settings.cell_refinement_width
        self.cell_features = (
            CellFeatures(width, features, refined, grid) if features else None
        )
        spaced = settings.agent_spacing_width if by_cell else 0
        self.spacing = CellSpacing(width, spaced, grid) if spaced else None
        self.density = DensityFeatures(width) if settings.density_features else None
        self.ego = EgoFeatures(width) if settings.ego_features else None

    def map_reach(self) -> NeighbourSpec:
        """How the query sees roads."""
        s = self.settings
        return NeighbourSpec.of(
            s.position_query_radius_m, s.position_query_map_neighbours, self.roads_relation
        )

    def agents_reach(self, agents: int) -> NeighbourSpec:
        """How the query sees agents: all of them within its radius."""
        return NeighbourSpec.of(
            self.settings.position_query_radius_m, agents, self.agents_relation
        )

    def forward(
        self,
        occupied: Tensor,
        roads: AttentionSources,
        agents: AttentionSources,
        average: Tensor | None,
        ego: Tensor | None,
    ) -> Tensor:
        """Answer queries: features [N, S, D].

        Args:
            occupied: 1 where a slot sees an agent in a cell, else 0 [N, S, cell].
            roads: Map tokens around the ego, the same for all slots.
            agents: Agents around the ego; ``present`` differs by slot [N, S, K].
            average: Moving averages of their number before this token step
                [N, constant], if that is used.
            ego: What ``self.ego`` says of the ego [N, D], if it is used.
        """
        x = self.query.weight[0] + self.occupancy(occupied)
        if self.density is not None and average is not None:
            count = agents.present.sum(dim=-1).view(len(average), -1).to(average.dtype)
            before = average[:, None].expand(*count.shape, -1)
            x = x + self.density(Density(count, before))
        if ego is not None:
            x = x + ego[:, None]
        for block in self.blocks:
            x = block(x, roads, agents)
        return x

    def answer(
        self,
        rows: Rows,
        x: Tensor,
        cell_features: Tensor | None,
        spaced: Tensor | None = None,
    ) -> InsertionOutputs:
        """Say of every row, by its updated features, whether an agent enters and where.

        Args:
            rows: What the features are of.
            x: The features [N, S, D].
            cell_features: Features of the cells, if they are used [N, cell, C].
                The more cells an agent might come from, the likelier one comes: it adds
                what they sum up to, before they are refined.
            spaced: What gaps to agents add to the logits of cells, if they are used
                [N, S, cell].
        """
        add, cell = self.add(x)[..., 0], None if self.cell is None else self.cell(x)
        if (
            self.cell_features is not None
            and cell is not None
            and cell_features is not None
        ):
            cell = cell + self.cell_features.choose(x, cell_features)
            add = add + cell.float().logsumexp(dim=-1) - math.log(self.num_cells)
            refined = self.cell_features.refine(x, cell_features)
            cell = cell if refined is None else cell + refined
        if cell is not None and spaced is not None:
            cell = cell + spaced
        return InsertionOutputs(
            rows,
            add,
            cell,
            None if self.place is None else self.radius_m * torch.tanh(self.place(x)),
            self.radius_m,
        )

    def occupied(self, cell: Tensor, seen: Tensor) -> Tensor:
        """Mark the cells [..., cell] that hold an agent that is seen.

        Args:
            cell: Cell of each agent [..., agent]; negative for none.
            seen: Whether it is seen [..., agent].
        """
        held = torch.where(seen & (cell >= 0), cell, self.num_cells)
        marks = torch.zeros((*held.shape[:-1], self.num_cells + 1), device=cell.device)
        return marks.scatter(-1, held, 1.0)[..., :-1]
