"""From poses to moves and back: the nearest row of a codebook, and where it leads.

Two moves are as far apart as the corners of a box at their ends are on average (SPEC 2.1).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int16

from infgen.geometry import box_corners, to_local, to_world
from infgen.tokens.codebook import MotionCodebook

_ROWS_AT_ONCE = 4096
"""Keeps the table of gaps (rows x moves) within 32 MiB."""


@dataclass(frozen=True, eq=False, slots=True)
class MoveTable:
    """A motion codebook laid out for matching.

    The *spread* of a pose is the point (x, y, r cos heading, r sin heading), where r is
    half the diagonal of the kind's box. The distance of two spreads is the root mean square
    distance of the corners. As opposite corners turn opposite ways, the mean distance is at
    most that, and at least 1 / sqrt(2) of it: so the nearest spread tells which few moves
    are worth measuring.

    Attributes:
        codebook: The moves.
        reach_m: Half the diagonal of each kind's box.
        spread: Spread of each move's end, kind by kind: one column per move.
        square: Its squared length.
        corners_m: Corners of each kind's box at each move's end: x of the four, then y.
    """

    codebook: MotionCodebook
    reach_m: Float32[np.ndarray, " 3"]
    spread: Float32[np.ndarray, "3 4 move"]
    square: Float32[np.ndarray, "3 move"]
    corners_m: Float64[np.ndarray, "3 move 8"]


def make_move_table(codebook: MotionCodebook) -> MoveTable:
    """Lay a codebook out for matching."""
    reach_m = np.linalg.norm(codebook.size_lw_m, axis=1) / np.float32(2)
    spread = _spread(codebook.end_pose, reach_m[:, None])
    return MoveTable(
        codebook=codebook,
        reach_m=reach_m,
        spread=np.ascontiguousarray(spread.swapaxes(1, 2)),
        square=(spread**2).sum(axis=-1),
        corners_m=_corners(codebook.end_pose, codebook.size_lw_m[:, None]),
    )


def nearest_moves(
    target: Float32[np.ndarray, "row 3"],
    pose: Float32[np.ndarray, "row 3"],
    kind: Int8[np.ndarray, " row"],
    table: MoveTable,
) -> Int16[np.ndarray, " row"]:
    """Find the move from each pose that ends nearest to each target.

    Nearest is the least mean distance of the corners of the kind's box; of equally near
    moves the first.

    Args:
        target: Where each agent is at the end of the move.
        pose: Where the move starts.
        kind: ``AgentKind`` of each agent.
        table: The moves to choose from.
    """
    move = np.empty(len(target), dtype=np.int16)
    for start in range(0, len(target), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        move[rows] = _nearest(to_local(target[rows], pose[rows]), kind[rows], table)
    return move


def advance(
    pose: Float32[np.ndarray, "agent 3"],
    kind: Int8[np.ndarray, " agent"],
    move: Int16[np.ndarray, " agent"],
    codebook: MotionCodebook,
) -> Float32[np.ndarray, "agent 3"]:
    """Move agents on by half a second; who has no move (a negative one) stays."""
    end = codebook.end_pose[kind, np.maximum(move, 0)]
    return np.where(move[:, None] >= 0, to_world(end, pose), pose)


def follow(
    target: Float32[np.ndarray, "agent 3"],
    pose: Float32[np.ndarray, "agent 3"],
    kind: Int8[np.ndarray, " agent"],
    table: MoveTable,
) -> tuple[Int16[np.ndarray, " agent"], Float32[np.ndarray, "agent 3"]]:
    """Write one half second of agents driven from outside as moves.

    Called once per half second with the pose it returned before, the chain of moves follows
    the targets, and an error of one move is corrected by the next.

    Returns:
        The moves, and the poses they lead to.
    """
    move = nearest_moves(target, pose, kind, table)
    return move, advance(pose, kind, move, table.codebook)


def _nearest(wanted: np.ndarray, kind: np.ndarray, table: MoveTable) -> np.ndarray:
    """Return the nearest move of each pose wanted in the frame of the one before."""
    corners_m = _corners(wanted, table.codebook.size_lw_m[kind])  # [row, 8]
    row, move = _candidates(wanted, corners_m, kind, table)
    gap_m = _mean_gap(table.corners_m[kind[row], move], corners_m[row])

    rows = np.arange(len(wanted))
    least = np.minimum.reduceat(gap_m, np.searchsorted(row, rows))
    best = np.flatnonzero(gap_m == least[row])
    return move[best[np.searchsorted(row[best], rows)]]


def _candidates(
    wanted: np.ndarray, corners_m: np.ndarray, kind: np.ndarray, table: MoveTable
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and moves, ascending, among which each row's nearest move surely is."""
    spread = _spread(wanted, table.reach_m[kind])
    gap = np.empty((len(wanted), table.codebook.num_moves), np.float32)  # less square
    for number in np.unique(kind):
        rows = np.flatnonzero(kind == number)
        gap[rows] = table.square[number] - 2 * spread[rows] @ table.spread[number]
    guess_m = _mean_gap(table.corners_m[kind, gap.argmin(axis=1)], corners_m)

    # The nearest move is at most as far as the guess, and its spread 1.42 times as far.
    square = (spread**2).sum(axis=-1)
    twice = (2 * guess_m**2).astype(np.float32)
    # Sixty roundings of a float32, relative to moves about as long as the one wanted.
    slack = np.float32(5e-6) * (square + twice)
    flat = np.flatnonzero(gap <= (twice - square + slack)[:, None])
    return np.divmod(flat, gap.shape[1])


def _mean_gap(one_m: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    """Return the mean distance of four corners; arrays are [box, 8]: all x, then all y."""
    away_m = ((one_m - other_m) ** 2).T
    return np.sqrt(away_m[:4] + away_m[4:]).sum(axis=0) / 4


def _corners(pose: np.ndarray, size_lw_m: np.ndarray) -> np.ndarray:
    """Return the corners [..., 8] of boxes: x of all four, then y of all four."""
    corners_m = box_corners(pose.astype(np.float64), size_lw_m.astype(np.float64))
    return corners_m.swapaxes(-1, -2).reshape(*pose.shape[:-1], 8)


def _spread(pose: np.ndarray, reach_m: np.ndarray) -> np.ndarray:
    heading = pose[..., 2]
    return np.stack(
        [
            pose[..., 0],
            pose[..., 1],
            reach_m * np.cos(heading),
            reach_m * np.sin(heading),
        ],
        axis=-1,
    )
