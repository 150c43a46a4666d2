"""Agents coming in: where and how each newcomer stands to the ego, in tokens.

A newcomer is a cell of the ego's grid and a bin of heading; the offset from the cell's
centre and the residual from the bin's middle are kept beside, so its pose comes back. The
pose it enters with *is* what these decode to.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16, Int64

from infgen.geometry import wrap_angle
from infgen.tokens.grid import (
    Grid,
    decode_cell,
    decode_heading,
    encode_cell,
    encode_heading,
    from_grid,
    to_grid,
)


@dataclass(frozen=True, slots=True)
class Insertions:
    """Newcomers, token by token.

    Attributes:
        token: Token at which each enters, ascending.
        agent: Its row.
        cell: Cell of the ego's grid, or ``NO_CELL``.
        offset_m: Position less the cell's centre, in the grid frame.
        heading: Heading bin relative to the ego.
        residual_rad: Relative heading less the bin's middle.
    """

    token: Int16[np.ndarray, " entry"]
    agent: Int16[np.ndarray, " entry"]
    cell: Int16[np.ndarray, " entry"]
    offset_m: Float32[np.ndarray, "entry 2"]
    heading: Int16[np.ndarray, " entry"]
    residual_rad: Float32[np.ndarray, " entry"]

    def at(self, token: int) -> "Insertions":
        """Return the newcomers of one token."""
        rows = slice(*np.searchsorted(self.token, [token, token + 1]))
        return Insertions(
            token=self.token[rows],
            agent=self.agent[rows],
            cell=self.cell[rows],
            offset_m=self.offset_m[rows],
            heading=self.heading[rows],
            residual_rad=self.residual_rad[rows],
        )


def encode_insertions(
    token: int,
    agent: Int64[np.ndarray, " entry"],
    pose: Float32[np.ndarray, "entry 3"],
    ego_pose: Float32[np.ndarray, "3"],
    grid: Grid,
) -> Insertions:
    """Write newcomers of one token by where they stand to the ego. Keeps their order."""
    xy_m = to_grid(pose[:, :2], ego_pose)
    relative_rad = wrap_angle(pose[:, 2] - ego_pose[2])
    cell, heading = encode_cell(xy_m, grid), encode_heading(relative_rad, grid)
    return Insertions(
        token=np.full(len(agent), token, dtype=np.int16),
        agent=agent.astype(np.int16),
        cell=cell,
        offset_m=xy_m - decode_cell(cell, grid),
        heading=heading,
        residual_rad=relative_rad - decode_heading(heading, grid),
    )


def decode_insertions(
    entries: Insertions, ego_pose: Float32[np.ndarray, "3"], grid: Grid
) -> Float32[np.ndarray, "entry 3"]:
    """Return the poses at which newcomers of one token enter."""
    xy_m = from_grid(decode_cell(entries.cell, grid) + entries.offset_m, ego_pose)
    relative_rad = decode_heading(entries.heading, grid) + entries.residual_rad
    heading_rad = wrap_angle(relative_rad + ego_pose[2])
    return np.concatenate([xy_m, heading_rad[:, None]], axis=-1)


def insertion_order(
    pose: Float32[np.ndarray, "entry 3"], ego_pose: Float32[np.ndarray, "3"], order: str
) -> Int64[np.ndarray, " entry"]:
    """Order newcomers of one token by their ``insertion_key``."""
    return np.argsort(insertion_key(pose, ego_pose, order), kind="stable")


def insertion_key(
    pose: Float32[np.ndarray, "entry 3"],
    ego_pose: Float32[np.ndarray, "*#entry 3"],
    order: str,
) -> Float32[np.ndarray, " entry"]:
    """Return what newcomers of one token are ordered by, ascending.

    Args:
        pose: Where they are.
        ego_pose: Where the ego is.
        order: ``distance``, near to far, or ``bearing``, from behind over the right, the
            front and the left to behind again.
    """
    away_m = pose[:, :2] - ego_pose[..., :2]
    if order == "distance":
        return np.hypot(away_m[:, 0], away_m[:, 1])
    return wrap_angle(np.arctan2(away_m[:, 1], away_m[:, 0]) - ego_pose[..., 2])


def join_insertions(parts: list[Insertions]) -> Insertions:
    """Lay the newcomers of consecutive tokens end to end."""
    return Insertions(
        token=np.concatenate([part.token for part in parts]),
        agent=np.concatenate([part.agent for part in parts]),
        cell=np.concatenate([part.cell for part in parts]),
        offset_m=np.concatenate([part.offset_m for part in parts]),
        heading=np.concatenate([part.heading for part in parts]),
        residual_rad=np.concatenate([part.residual_rad for part in parts]),
    )
