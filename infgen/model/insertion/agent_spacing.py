"""How far inserted agents keep from others: gaps to the boxes of agents around.

Features of cells know agents by the lattice points around their centres, and offset bins
do not know them at all, so a vehicle that joins a row of parked ones is inserted onto its
neighbour, or close ahead of a moving one. Here each agent has a say of the points around it
by their gaps along and beside its own box and what that sweeps within a second. What agents
say is added up, so that of one inserted a turn before is added to what is there already.

Shape letters as in ``layers``; P are pairs of a query and an agent, L points around the
agent, C the width of these features.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from infgen.model.insertion.cell_features import chosen
from infgen.model.layers import full_precision, gather
from infgen.model.neighbours import grid_place
from infgen.tokens.grid import Grid

REACH_M = 10.5
"""Agents have a say of points so far from their centres, less and less."""
KNOTS = 21
"""Gaps are told apart at so many knots on either axis, from one side to the other ..."""
FINE_M = 2.0
"""... which lie densest within about so much of the box."""
SWEPT_TOKENS = 2.0
"""What a box sweeps in so many token steps counts as part of it ..."""
MAX_SWEPT_M = 15.0
"""... up to so much."""


@dataclass(frozen=True, slots=True)
class SpacedAgents:
    """Agents around queries.

    Attributes:
        features: Features of all agents [M, D].
        row: Row of each query's agents among them [N, K].
        pose: Poses of the boxes that they sweep (``swept``) [N, K, 3] ...
        size_lw_m: ... and their sizes [N, K, 2].
        present: Which of them there are [N, K].
    """

    features: Tensor
    row: Tensor
    pose: Tensor
    size_lw_m: Tensor
    present: Tensor


@dataclass(frozen=True, slots=True)
class SpacedCells:
    """What agents say of the cells around them.

    Attributes:
        query: Whose cells [P].
        agent: Which of that query's agents says it [P].
        cell: The cells; their number for none [P, L].
        keys: What is said [P, L, C].
    """

    query: Tensor
    agent: Tensor
    cell: Tensor
    keys: Tensor


def swept(
    pose: Float32[Tensor, "*agent 3"],
    size_lw_m: Float32[Tensor, "*agent 2"],
    step_m: Float32[Tensor, "*agent 2"],
    token_steps: float = SWEPT_TOKENS,
) -> tuple[Float32[Tensor, "*agent 3"], Float32[Tensor, "*agent 2"]]:
    """Return the boxes that agents sweep, if they move on as they did.

    Args:
        pose: Poses.
        size_lw_m: Boxes.
        step_m: Displacements in the last token step; zero where they are not known.
        token_steps: Within so many.

    Returns:
        Poses and sizes of the swept boxes.
    """
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    ahead_m = cos * step_m[..., 0] + sin * step_m[..., 1]
    ahead_m = (token_steps * ahead_m).clamp(0, MAX_SWEPT_M)
    none = torch.zeros_like(ahead_m)
    half_m = ahead_m / 2
    moved = torch.stack([half_m * cos, half_m * sin, none], dim=-1)
    return pose + moved, size_lw_m + torch.stack([ahead_m, none], dim=-1)


class AgentSpacing(nn.Module):
    """What agents say of points around them, and what queries make of it."""

    knot: Tensor

    def __init__(self, width: int, spacing_width: int) -> None:
        super().__init__()
        self.agent = nn.Linear(width, spacing_width)
        self.along = nn.Linear(KNOTS, spacing_width, bias=False)
        self.beside = nn.Linear(KNOTS, spacing_width, bias=False)
        self.ask = nn.Linear(width, spacing_width)
        knot = torch.arange(KNOTS, dtype=torch.float32) - KNOTS // 2
        self.register_buffer("knot", knot, persistent=False)

    def begin_at_zero(self) -> None:
        """Change no logit until it is trained.

        Agents begin with one bump a feature: ahead of the box or behind it, in its own lane
        or, for the second half of the features, in those beside.
        """
        channels = len(self.along.weight)
        half = max(channels // 2, 1)
        ahead = torch.linspace(-KNOTS // 2 + 2, KNOTS // 2 - 2, half)
        ahead = ahead.repeat(-(-channels // half))[:channels, None]
        is_beside = (torch.arange(channels) >= half)[:, None]
        away = torch.where(is_beside, self.knot.abs() - KNOTS / 4, self.knot)
        with torch.no_grad():
            self.along.weight.copy_((-(((self.knot - ahead) / 2) ** 2)).exp())
            self.beside.weight.copy_((-((away / 2) ** 2)).exp())
            nn.init.zeros_(self.ask.weight)
            nn.init.zeros_(self.ask.bias)

    def forward(
        self, features: Tensor, turned_rad: Tensor, size_lw_m: Tensor, away_m: Tensor
    ) -> Tensor:
        """Describe points around agents: [P, L, C].

        Args:
            features: Features of the agents [P, D].
            turned_rad: Their headings in the frame of the points [P].
            size_lw_m: Their boxes [P, 2].
            away_m: The points, less the agents' centres [P, L, 2].
        """
        cos, sin = turned_rad.cos(), turned_rad.sin()
        turn = torch.stack([cos, -sin, sin, cos], dim=-1).view(-1, 2, 2)
        with full_precision(away_m):
            apart_m, half_m = away_m @ turn, (size_lw_m / 2)[:, None]
        gap_m = apart_m - apart_m.clamp(-half_m, half_m)  # 0 within the box.
        along, beside = self._shares(gap_m).unbind(-2)
        fades = (1 - away_m.square().sum(dim=-1, keepdim=True) / REACH_M**2).clamp(min=0)
        told: Tensor = self.along(along) * self.beside(beside)
        return told * fades * self.agent(features)[:, None]

    def asked(self, x: Tensor) -> Tensor:
        """Return what queries [..., D] make of the features: [..., C]."""
        asked: Tensor = self.ask(x) * self.ask.out_features**-0.5
        return asked

    def _shares(self, gap_m: Tensor) -> Tensor:
        """Share gaps out between the two nearest knots: [..., knot]."""
        most = np.log1p(REACH_M / FINE_M)
        at = (gap_m.abs() / FINE_M).log1p().copysign(gap_m) * ((KNOTS // 2) / most)
        return (1 - (at[..., None] - self.knot).abs()).clamp(min=0)


class CellSpacing(AgentSpacing):
    """What agents say of the cells around them."""

    cell_at: Tensor
    around: Tensor

    def __init__(self, width: int, spacing_width: int, grid: Grid) -> None:
        super().__init__(width, spacing_width)
        self.num_cells = grid.num_cells
        self.step_m = grid.step_m
        self.side = len(grid.cell_at)
        cell_at = np.where(grid.cell_at < 0, grid.num_cells, grid.cell_at)
        self.register_buffer("cell_at", torch.from_numpy(cell_at), persistent=False)
        reach = int(np.ceil(REACH_M / grid.step_m))
        ticks = torch.arange(-reach, reach + 1, dtype=torch.float32)
        around = torch.cartesian_prod(ticks, ticks)  # column, row
        self.register_buffer("around", around, persistent=False)

    def cells(self, ego_pose: Tensor, agents: SpacedAgents) -> SpacedCells:
        """Describe the cells around the agents around egos [N, 3]."""
        reach_m = REACH_M + self.step_m * self.side / 2
        place_m = grid_place(agents.pose, ego_pose[:, None])
        near = (place_m.abs() < reach_m).all(dim=-1)
        query, agent, counts = chosen(agents.present & near)
        cell, keys = self.around_each(
            ego_pose[query],
            gather(agents.features, agents.row[query, agent]),
            agents.pose[query, agent],
            agents.size_lw_m[query, agent],
        )
        keys = keys if counts is None else keys * counts[..., None]
        return SpacedCells(query, agent, cell, keys)

    def around_each(
        self, ego_pose: Tensor, features: Tensor, pose: Tensor, size_lw_m: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Describe the cells around each agent.

        Args:
            ego_pose: Pose of its ego [P, 3].
            features: Features of the agents [P, D].
            pose: Their poses [P, 3].
            size_lw_m: Their boxes [P, 2].

        Returns:
            The cells, their number for none [P, L], and what is said of them [P, L, C].
        """
        last = self.side - 1
        at = grid_place(pose, ego_pose) / self.step_m + last / 2  # column, row
        point = at.round()[:, None] + self.around  # [P, L, 2]
        on_lattice = point.clamp(0, last)
        inside = (point == on_lattice).all(dim=-1)
        column, row = on_lattice.long().unbind(-1)
        cell = torch.where(inside, self.cell_at[row, column], self.num_cells)
        away_m = (point - at[:, None]) * self.step_m
        turned_rad = pose[:, 2] - ego_pose[:, 2] + np.pi / 2
        return cell, self(features, turned_rad, size_lw_m, away_m)

    def lay_out(self, grid: Tensor, cell: Tensor, keys: Tensor, laid: Tensor) -> None:
        """Add what agents say to what is said of the cells of grids, in place.

        Args:
            grid: Number of each agent's grid [P].
            cell: Cells [P, L] ...
            keys: ... and what is said of them [P, L, C].
            laid: What is said so far, of all grids [grid, cell + 1, C]: none is a cell too.
        """
        at = grid[:, None] * laid.shape[1] + cell
        laid.flatten(0, 1).index_add_(0, at.flatten(), keys.flatten(0, 1).to(laid.dtype))

    def choose(self, x_NSD: Tensor, keys_NPC: Tensor) -> Tensor:
        """Say how much queries are for each cell: logits [N, S, cell].

        Args:
            x_NSD: Queries.
            keys_NPC: What is laid out for each.
        """
        logits: Tensor = self.asked(x_NSD) @ keys_NPC.mT
        return logits[..., : self.num_cells]

    def choose_each(self, x_NSD: Tensor, said: SpacedCells, turn_NK: Tensor) -> Tensor:
        """Do the same where each slot sees those inserted in turns before it.

        Args:
            x_NSD: Queries.
            said: What agents say.
            turn_NK: Turn in which each agent was inserted, negative if it was before.
        """
        queries, slots, _ = x_NSD.shape
        asked = self.asked(x_NSD)[said.query]  # [P, S, C]
        slot = torch.arange(slots, device=x_NSD.device)
        seen = turn_NK[said.query, said.agent][:, None] < slot
        told = (asked @ said.keys.mT) * seen[..., None]  # [P, S, L]
        at = (said.query[:, None] * slots + slot) * (self.num_cells + 1)
        at = at[..., None] + said.cell[:, None]
        logits = told.new_zeros(queries * slots * (self.num_cells + 1))
        logits = logits.index_add(0, at.flatten(), told.flatten())
        return logits.view(queries, slots, -1)[..., :-1]


class OffsetSpacing(AgentSpacing):
    """What agents say of the offset bins of a cell beside them."""

    offset_m: Tensor

    def __init__(self, width: int, spacing_width: int, grid: Grid) -> None:
        super().__init__(width, spacing_width)
        offset_m = torch.from_numpy(grid.offset_m.copy())
        self.register_buffer("offset_m", offset_m, persistent=False)

    def choose(self, x_ND: Tensor, pose: Tensor, agents: SpacedAgents) -> Tensor:
        """Say how much queries at poses [N, 3] are for each bin: logits [N, offset]."""
        query, agent, counts = chosen(agents.present)
        place_m = grid_place(agents.pose, pose[:, None])[query, agent]
        turned_rad = agents.pose[query, agent, 2] - pose[query, 2] + np.pi / 2
        features = gather(agents.features, agents.row[query, agent])
        away_m = self.offset_m - place_m[:, None]
        keys = self(features, turned_rad, agents.size_lw_m[query, agent], away_m)
        told = (keys @ self.asked(x_ND)[query][..., None])[..., 0]
        if counts is not None:
            told = told * counts
        return told.new_zeros((len(x_ND), told.shape[1])).index_add(0, query, told)
