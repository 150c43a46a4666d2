"""A closer look at the cells where inserted agents may enter.

Features of cells (``cell_features``) are a sum over what lies on a cell and beside it, of
one hidden layer: enough to tell a lane from a lawn, too little to tell where along a lane,
or between which two parked vehicles. Here each cell is told of what is up to 9 m away, in
its arrangement. It says where an agent is inserted, not whether: log-odds of ADD do not
depend on it.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from infgen.model.layers import embedding_mlp, full_precision
from infgen.model.settings import REFINEMENT_GROUPS

DILATION = 2
"""Lattice points from one to the next that the second convolution looks at."""


class CellRefinement(nn.Module):
    """Logits of cells, from features that are laid onto a lattice."""

    centre_m: Tensor

    def __init__(
        self, width: int, cell_feature_width: int, refinement_width: int, centre_m: Tensor
    ) -> None:
        """Begin with random weights.

        Args:
            width: Of the queries.
            cell_feature_width: Of what is laid onto the lattice.
            refinement_width: Of the features here, a multiple of ``REFINEMENT_GROUPS``.
            centre_m: Place of each lattice point in the grid frame [point, 2].
        """
        super().__init__()
        self.register_buffer("centre_m", centre_m, persistent=False)
        hidden = refinement_width
        self.place = embedding_mlp(2, hidden)
        self.near = nn.Conv2d(cell_feature_width, hidden, 3, padding=1, bias=False)
        self.far = nn.Conv2d(
            hidden, hidden, 3, padding=DILATION, dilation=DILATION, groups=REFINEMENT_GROUPS
        )
        self.key = nn.Linear(hidden, cell_feature_width)
        self.ask = nn.Linear(width, cell_feature_width)

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained."""
        nn.init.zeros_(self.key.weight)
        nn.init.zeros_(self.key.bias)

    def forward(self, laid: Tensor, lattice: Tensor) -> Tensor:
        """Describe cells: features [N, cell, C].

        Convolutions are in float32 also under autocast: on CPUs the gradient of ``far`` in
        bf16 was now and then not finite (torch 2.13).

        Args:
            laid: What lies on the lattice [N, C, side, side].
            lattice: The lattice point of each cell [cell].
        """
        place = self.place(self.centre_m).mT.view(1, -1, *laid.shape[2:])
        with full_precision(laid):
            near = functional.relu(self.near(laid) + place.to(laid.dtype))
            seen = functional.relu(near + self.far(near))
        keys: Tensor = self.key(seen.flatten(2)[..., lattice].mT)
        return keys

    def choose(self, x_NSD: Tensor, cells_NPC: Tensor) -> Tensor:
        """Say how much queries are for each cell: logits [N, S, cell]."""
        asked = self.ask(x_NSD) * cells_NPC.shape[-1] ** -0.5
        logits: Tensor = asked @ cells_NPC.mT
        return logits


def lattice_centres_m(side: int, step_m: float) -> Tensor:
    """Place of the lattice points in the grid frame, row by row [point, 2]."""
    along_m = (torch.arange(side, dtype=torch.float32) - (side - 1) / 2) * step_m
    x_m, y_m = along_m.expand(side, side), along_m[:, None].expand(side, side)
    return torch.stack([x_m, y_m], dim=-1).flatten(0, 1)
