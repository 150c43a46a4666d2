"""Insertions as tokens: position cell and heading bin of each agent relative to the ego.

The offset from the cell's centre and the residual from the bin's middle are kept too. The
pose of an inserted agent is by definition what its insertion decodes to.
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
    """Insertions of a scene, in the order of their token steps.

    Attributes:
        token: Token step of each insertion, ascending.
        agent: Row of the agent.
        cell: Cell of the ego's grid, or ``NO_CELL``.
        offset_m: Position less the cell's centre, in the grid frame.
        heading: Heading bin relative to the ego.
        residual_rad: Relative heading less the bin's middle.
    """

    token: Int16[np.ndarray, " insertion"]
    agent: Int16[np.ndarray, " insertion"]
    cell: Int16[np.ndarray, " insertion"]
    offset_m: Float32[np.ndarray, "insertion 2"]
    heading: Int16[np.ndarray, " insertion"]
    residual_rad: Float32[np.ndarray, " insertion"]

    def at(self, token: int) -> "Insertions":
        """Return the insertions of one token step."""
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
    agent: Int64[np.ndarray, " insertion"],
    pose: Float32[np.ndarray, "insertion 3"],
    ego_pose: Float32[np.ndarray, "3"],
    grid: Grid,
) -> Insertions:
    """Encode the poses of the agents inserted at one token step, in the given order."""
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
    insertions: Insertions, ego_pose: Float32[np.ndarray, "3"], grid: Grid
) -> Float32[np.ndarray, "insertion 3"]:
    """Decode the poses of insertions at one step. Inverse of ``encode_insertions``."""
    xy_m = from_grid(decode_cell(insertions.cell, grid) + insertions.offset_m, ego_pose)
    relative_rad = decode_heading(insertions.heading, grid) + insertions.residual_rad
    heading_rad = wrap_angle(relative_rad + ego_pose[2])
    return np.concatenate([xy_m, heading_rad[:, None]], axis=-1)


def insertion_order(
    pose: Float32[np.ndarray, "insertion 3"], ego_pose: Float32[np.ndarray, "3"], order: str
) -> Int64[np.ndarray, " insertion"]:
    """Return the rows of agents inserted at one step, ordered by ``insertion_key``."""
    return np.argsort(insertion_key(pose, ego_pose, order), kind="stable")


def insertion_key(
    pose: Float32[np.ndarray, "insertion 3"],
    ego_pose: Float32[np.ndarray, "*#insertion 3"],
    order: str,
) -> Float32[np.ndarray, " insertion"]:
    """Return the sort key of agents inserted at one token step, ascending.

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
    """Concatenate the insertions of consecutive token steps."""
    return Insertions(
        token=np.concatenate([part.token for part in parts]),
        agent=np.concatenate([part.agent for part in parts]),
        cell=np.concatenate([part.cell for part in parts]),
        offset_m=np.concatenate([part.offset_m for part in parts]),
        heading=np.concatenate([part.heading for part in parts]),
        residual_rad=np.concatenate([part.residual_rad for part in parts]),
    )
