"""Where agents are around the ego: a disk of square cells, and bins of heading.

Grid frame: metres from the ego, +y the way it faces, +x to its right (SPEC 3.1). Cells are
the points of a square lattice within a radius, numbered row by row from the front, each row
from left to right; the ego's own cell is the middle one. What the cell and the bin leave
out, the offset and the residual keep, so decoding gives the pose back.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Int16, Int64

from infgen.errors import ConfigError
from infgen.geometry import rotate, wrap_angle
from infgen.tokens.scene_tokens import NO_CELL
from infgen.tokens.settings import TokenSettings

_QUARTER_TURN_RAD = np.float32(np.pi / 2)
OFFSET_BINS_ACROSS = 12
"""A cell has so many offset bins along each of its sides."""
_AROUND = np.array([[x, y] for y in (1, 0, -1) for x in (-1, 0, 1)])
"""The squares around one, and itself, in the order of cells."""


@dataclass(frozen=True, eq=False, slots=True)
class Grid:
    """The cells around an ego and the bins of heading relative to it.

    Attributes:
        radius_m: Points farther from the ego are in no cell.
        step_m: From one cell's centre to the next.
        centre_m: Centre of each cell, in the grid frame.
        cell_at: Cell at each point of the square lattice around the disk, row by row from
            the rear, each from left to right; ``NO_CELL`` outside the disk.
        num_headings: Number of heading bins in a full turn.
    """

    radius_m: float
    step_m: float
    centre_m: Float32[np.ndarray, "cell 2"]
    cell_at: Int64[np.ndarray, "side side"]
    num_headings: int

    @property
    def num_cells(self) -> int:
        """Number of cells: the size of the position vocabulary."""
        return len(self.centre_m)

    @property
    def ego_cell(self) -> int:
        """The cell around the ego itself."""
        return self.num_cells // 2

    @property
    def offset_step_m(self) -> float:
        """Side of an offset bin."""
        return self.step_m / OFFSET_BINS_ACROSS

    @property
    def offset_m(self) -> Float32[np.ndarray, "offset 2"]:
        """Middle of each offset bin less the centre of its cell, in the grid frame.

        Row by row from the rear of the cell, each from left to right.
        """
        return _offset_middles_m(self.step_m)

    @property
    def heading_step_rad(self) -> float:
        """Width of a heading bin."""
        return 2 * math.pi / self.num_headings

    @property
    def heading_centre_rad(self) -> Float32[np.ndarray, " heading"]:
        """Heading at the middle of each bin, relative to the ego."""
        return _heading_centres_rad(self.num_headings)


@lru_cache(maxsize=16)
def _heading_centres_rad(count: int) -> Float32[np.ndarray, " heading"]:
    bins = np.arange(count) + 0.5
    return (bins * (2 * math.pi / count) - np.pi).astype(np.float32)


@lru_cache(maxsize=16)
def _offset_middles_m(step_m: float) -> Float32[np.ndarray, "offset 2"]:
    middles_m = ((np.arange(OFFSET_BINS_ACROSS) + 0.5) / OFFSET_BINS_ACROSS - 0.5) * step_m
    y_m, x_m = np.meshgrid(middles_m, middles_m, indexing="ij")
    return np.stack([x_m, y_m], axis=-1).reshape(-1, 2).astype(np.float32)


@lru_cache(maxsize=16)
def make_grid(settings: TokenSettings) -> Grid:
    """Lay out the cells and bins that the settings describe.

    Raises:
        ConfigError: if there would be more cells than an int16 can number.
    """
    radius_m, step_m = settings.grid_radius_m, settings.grid_cell_m
    reach = int(radius_m / step_m + 1e-9)
    if 4 * reach * reach > np.iinfo(np.int16).max:
        raise ConfigError(
            f"a grid of radius {radius_m} m and step {step_m} m has too many cells "
            f"({2 * reach + 1} across); try a step of {2 * radius_m / 180:.2g} m or more"
        )
    ticks = np.arange(-reach, reach + 1)
    inside = np.hypot(ticks[:, None], ticks) * step_m <= radius_m + 1e-6  # [row, column]
    rows, columns = np.nonzero(inside[::-1])
    cell_at = np.full(inside.shape, NO_CELL, dtype=np.int64)
    cell_at[2 * reach - rows, columns] = np.arange(len(rows))
    centre_m = np.column_stack([ticks[columns], -ticks[rows]]) * step_m
    return Grid(
        radius_m=radius_m,
        step_m=step_m,
        centre_m=centre_m.astype(np.float32),
        cell_at=cell_at,
        num_headings=round(360 / settings.heading_bin_deg),
    )


def to_grid(
    xy_m: Float32[np.ndarray, "*batch 2"], ego_pose: Float32[np.ndarray, "*#batch 3"]
) -> Float32[np.ndarray, "*batch 2"]:
    """Bring world points to the grid frame of an ego. Inverse of ``from_grid``."""
    turn_rad = np.asarray(_QUARTER_TURN_RAD - ego_pose[..., 2])
    return rotate(xy_m - ego_pose[..., :2], turn_rad)


def from_grid(
    xy_m: Float32[np.ndarray, "*batch 2"], ego_pose: Float32[np.ndarray, "*#batch 3"]
) -> Float32[np.ndarray, "*batch 2"]:
    """Bring points of an ego's grid frame to the world."""
    turn_rad = np.asarray(ego_pose[..., 2] - _QUARTER_TURN_RAD)
    return rotate(xy_m, turn_rad) + ego_pose[..., :2]


def encode_cell(
    xy_m: Float32[np.ndarray, "*batch 2"], grid: Grid
) -> Int16[np.ndarray, "*batch"]:
    """Find the cell whose centre is nearest to each point of the grid frame.

    Points beyond the radius get ``NO_CELL``. A point's lattice square tells its cell, but
    for the few at the rim whose square has its centre outside the disk.
    """
    reach = len(grid.cell_at) // 2
    tick = np.rint(xy_m / np.float32(grid.step_m)).astype(np.int64)
    tick = np.minimum(np.maximum(tick, -reach), reach)
    cell = grid.cell_at[tick[..., 1] + reach, tick[..., 0] + reach]
    inside = np.hypot(xy_m[..., 0], xy_m[..., 1]) <= grid.radius_m
    rim = inside & (cell == NO_CELL)
    if rim.any():
        cell[rim] = _nearest_around(xy_m[rim], tick[rim] + reach, grid)
    return np.where(inside, cell, NO_CELL).astype(np.int16)


def _nearest_around(
    xy_m: Float32[np.ndarray, "point 2"], at: Int64[np.ndarray, "point 2"], grid: Grid
) -> Int64[np.ndarray, " point"]:
    """Find the nearest cell to each point, the first of them, around its lattice square.

    The nearest is in none but the nine squares there: towards the ego along both axes, one
    of them is a cell, and no farther away than a square's diagonal.
    """
    around = (at[:, None] + _AROUND).clip(0, len(grid.cell_at) - 1)
    cell = grid.cell_at[around[..., 1], around[..., 0]]  # [point, 9]
    away_m = xy_m[:, None] - grid.centre_m[cell]
    x_m, y_m = away_m[..., 0], away_m[..., 1]
    gap_m = np.where(cell == NO_CELL, np.inf, np.sqrt(x_m * x_m + y_m * y_m))
    return cell[np.arange(len(cell)), gap_m.argmin(axis=1)]


def decode_cell(
    cell: Int16[np.ndarray, "*batch"], grid: Grid
) -> Float32[np.ndarray, "*batch 2"]:
    """Return each cell's centre in the grid frame; the ego itself for ``NO_CELL``."""
    centre_m = grid.centre_m[cell]
    return np.where(cell[..., None] == NO_CELL, np.float32(0), centre_m)


def encode_heading(
    relative_rad: Float32[np.ndarray, "*batch"], grid: Grid
) -> Int16[np.ndarray, "*batch"]:
    """Find the bin of headings relative to the ego."""
    turn = (wrap_angle(relative_rad) + np.float32(np.pi)) / np.float32(2 * np.pi)
    bins = np.floor(turn * grid.num_headings)
    return np.clip(bins, 0, grid.num_headings - 1).astype(np.int16)


def decode_heading(
    heading: Int16[np.ndarray, "*batch"], grid: Grid
) -> Float32[np.ndarray, "*batch"]:
    """Return the heading at the middle of each bin, relative to the ego."""
    return grid.heading_centre_rad[heading]


def encode_offset(
    offset_m: Float32[np.ndarray, "*batch 2"], grid: Grid
) -> Int16[np.ndarray, "*batch"]:
    """Find the offset bin of positions less the centre of their cell, in the grid frame.

    At the rim of the grid a position may be outside its cell: it gets the nearest bin.
    """
    bins = np.floor(offset_m / np.float32(grid.offset_step_m)) + OFFSET_BINS_ACROSS // 2
    column, row = np.clip(bins, 0, OFFSET_BINS_ACROSS - 1).astype(np.int16).T
    found: np.ndarray = (row * OFFSET_BINS_ACROSS + column).T
    return found


def decode_offset(
    offset: Int16[np.ndarray, "*batch"], grid: Grid
) -> Float32[np.ndarray, "*batch 2"]:
    """Return the middle of each offset bin less the centre of its cell."""
    return grid.offset_m[offset]
