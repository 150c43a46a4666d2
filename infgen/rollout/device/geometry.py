"""Boxes that overlap, and the cells of ``infgen.tokens.grid``, for tensors."""

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.batching.frames import rotate
from infgen.tokens.grid import Grid
from infgen.tokens.scene_tokens import NO_CELL


def boxes_overlap(
    pose: Float32[Tensor, "*#shape 3"],
    size_lw_m: Float32[Tensor, "*#shape 2"],
    other: Float32[Tensor, "*#shape 3"],
    other_size_lw_m: Float32[Tensor, "*#shape 2"],
) -> Bool[Tensor, "*shape"]:
    """Tell which boxes overlap; boxes that only touch do not."""
    return ~(
        _separates(pose, size_lw_m, other, other_size_lw_m)
        | _separates(other, other_size_lw_m, pose, size_lw_m)
    )


def _separates(
    pose: Tensor, size_lw_m: Tensor, other: Tensor, other_size_lw_m: Tensor
) -> Tensor:
    """Whether the other box lies wholly beyond an end or a side of the first."""
    away_m = rotate(other[..., :2] - pose[..., :2], -pose[..., 2]).abs()
    turned_rad = other[..., 2] - pose[..., 2]
    cos, sin = turned_rad.cos().abs(), turned_rad.sin().abs()
    length_m, width_m = (other_size_lw_m / 2).unbind(-1)
    ahead_m = cos * length_m + sin * width_m + size_lw_m[..., 0] / 2
    aside_m = sin * length_m + cos * width_m + size_lw_m[..., 1] / 2
    return (away_m[..., 0] >= ahead_m) | (away_m[..., 1] >= aside_m)


class DeviceGrid:
    """The cells of ``infgen.tokens.grid`` on a device."""

    def __init__(self, grid: Grid, device: torch.device) -> None:
        """Bring the tables of a grid to a device."""
        self.grid = grid
        self.centre_m = torch.from_numpy(grid.centre_m.copy()).to(device)
        self.offset_m = torch.from_numpy(grid.offset_m.copy()).to(device)
        self.heading_rad = torch.from_numpy(grid.heading_centre_rad).to(device)
        self._cell_at = torch.from_numpy(grid.cell_at.copy()).to(device)

    def encode_cell(self, xy_m: Float32[Tensor, "point 2"]) -> Int64[Tensor, " point"]:
        """Find the cell whose centre is nearest to each point; ``NO_CELL`` far away."""
        reach = len(self._cell_at) // 2
        tick = torch.round(xy_m / self.grid.step_m).long().clamp(-reach, reach) + reach
        cell = self._cell_at[tick[:, 1], tick[:, 0]]
        inside = torch.hypot(xy_m[:, 0], xy_m[:, 1]) <= self.grid.radius_m
        # At the rim the centre of a point's square may be outside the disk.
        gap_m = torch.linalg.vector_norm(xy_m[:, None] - self.centre_m, dim=-1)
        cell = torch.where(cell == NO_CELL, gap_m.argmin(dim=1), cell)
        return torch.where(inside, cell, NO_CELL)

    def within(
        self, position_m: Float32[Tensor, "point 2"], share: float
    ) -> Float32[Tensor, "point 2"]:
        """Move positions beyond a share of the radius to there."""
        far = torch.hypot(position_m[:, 0], position_m[:, 1]) / (share * self.grid.radius_m)
        return position_m / far.clamp(min=1)[:, None]
