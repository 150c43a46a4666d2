"""From poses to moves and back: the nearest row of a vocabulary, and where it leads.

Two moves are as far apart as the corners of a box at their ends are on average (SPEC 2.1).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int16

from infgen.geometry import box_corners, to_local, to_world
from infgen.tokens.vocabulary import MotionVocabulary

_BLOCK_ROWS = 4096
"""Keeps the table of gaps (rows x moves) within 32 MiB."""


@dataclass(frozen=True, eq=False, slots=True)
class MatchTable:
    """A motion vocabulary laid out for matching.

    The *spread* of a pose is the point (x, y, r cos heading, r sin heading), where r is
    half the diagonal of the kind's box. The distance of two spreads is the root mean square
    distance of the corners. As opposite corners turn opposite ways, the mean distance is at
    most that, and at least 1 / sqrt(2) of it: so the nearest spread tells which few moves
    are worth measuring.

    Attributes:
        vocabulary: The moves.
        reach_m: Half the diagonal of each kind's box.
        weights: One column per move and kind: the spread of its end times -2, then its
            squared length. The product with a spread and a one is the squared distance of
            the two less the square of the one.
        corners_m: Corners of each kind's box at each move's end: x of the four, then y.
    """

    vocabulary: MotionVocabulary
    reach_m: Float32[np.ndarray, " 3"]
    weights: Float32[np.ndarray, "3 5 move"]
    corners_m: Float64[np.ndarray, "3 move 8"]


@lru_cache(maxsize=4)
def make_match_table(vocabulary: MotionVocabulary) -> MatchTable:
    """Lay a vocabulary out for matching; of the last few vocabularies only once."""
    reach_m = np.linalg.norm(vocabulary.size_lw_m, axis=1) / np.float32(2)
    spread = _spread(vocabulary.end_pose, reach_m[:, None]).swapaxes(1, 2)
    square = (spread**2).sum(axis=1, keepdims=True)
    return MatchTable(
        vocabulary=vocabulary,
        reach_m=reach_m,
        weights=np.concatenate([-2 * spread, square], axis=1),
        corners_m=_corners(vocabulary.end_pose, vocabulary.size_lw_m[:, None]),
    )


@lru_cache(maxsize=4)
def neighbour_tokens(table: MatchTable, count: int) -> Int16[np.ndarray, "3 move near"]:
    """Return for each move some that end near to it, itself (or a twin) among them.

    Args:
        table: The moves.
        count: How many.
    """
    near = []
    for weights in table.weights:
        spread = np.concatenate([weights[:4] / -2, np.ones_like(weights[:1])])
        gap = spread.T @ weights  # [move, move], less the square of the row
        near.append(np.argpartition(gap, count - 1, axis=1)[:, :count])
    return np.stack(near).astype(np.int16)


def nearest_motion_tokens(
    target: Float32[np.ndarray, "row 3"],
    pose: Float32[np.ndarray, "row 3"],
    kind: Int8[np.ndarray, " row"],
    table: MatchTable,
) -> Int16[np.ndarray, " row"]:
    """Find the move from each pose that ends nearest to each target.

    Nearest is the least mean distance of the corners of the kind's box; of equally near
    moves the first.

    Args:
        target: Where each agent is at the end of the move.
        pose: Where the move starts.
        kind: ``AgentType`` of each agent.
        table: The moves to choose from.
    """
    return nearest_k_motion_tokens(target, pose, kind, table, 1)[:, 0]


def nearest_k_motion_tokens(
    target: Float32[np.ndarray, "row 3"],
    pose: Float32[np.ndarray, "row 3"],
    kind: Int8[np.ndarray, " row"],
    table: MatchTable,
    count: int,
) -> Int16[np.ndarray, "row near"]:
    """Find the few moves from each pose that end nearest to each target, nearest first.

    What near is and the arguments are as for ``nearest_motion_tokens``, the first of these;
    there must be ``count`` moves.
    """
    order = np.argsort(kind, kind="stable")
    move = np.empty((len(order), count), dtype=np.int16)
    near = neighbour_tokens(table, count)
    for start in range(0, len(order), _BLOCK_ROWS):
        rows = order[start : start + _BLOCK_ROWS]
        wanted = to_local(target[rows], pose[rows])
        move[rows] = _nearest(wanted, kind[rows], table, near)
    return move


def advance(
    pose: Float32[np.ndarray, "agent 3"],
    kind: Int8[np.ndarray, " agent"],
    move: Int16[np.ndarray, " agent"],
    vocabulary: MotionVocabulary,
) -> Float32[np.ndarray, "agent 3"]:
    """Move agents on by half a second; who has no move (a negative one) stays."""
    end = vocabulary.end_pose[kind, np.maximum(move, 0)]
    return np.where(move[:, None] >= 0, to_world(end, pose), pose)


def follow(
    target: Float32[np.ndarray, "agent 3"],
    pose: Float32[np.ndarray, "agent 3"],
    kind: Int8[np.ndarray, " agent"],
    table: MatchTable,
) -> tuple[Int16[np.ndarray, " agent"], Float32[np.ndarray, "agent 3"]]:
    """Write one half second of agents driven from outside as moves.

    Called once per half second with the pose it returned before, the chain of moves follows
    the targets, and an error of one move is corrected by the next.

    Returns:
        The moves, and the poses they lead to.
    """
    move = nearest_motion_tokens(target, pose, kind, table)
    return move, advance(pose, kind, move, table.vocabulary)


def _nearest(
    wanted: np.ndarray, kind: np.ndarray, table: MatchTable, near: np.ndarray
) -> np.ndarray:
    """Return the nearest moves [row, few] of each pose wanted; ``kind`` ascends."""
    corners_m = _corners(wanted, table.vocabulary.size_lw_m[kind])  # [row, 8]
    row, move = _candidates(wanted, corners_m, kind, table, near)
    gap_m = _mean_gap(table.corners_m[kind[row], move], corners_m[row])

    order = np.lexsort([gap_m, row])  # Stable: of equally near moves the first.
    first = np.searchsorted(row, np.arange(len(wanted)))
    return move[order[first[:, None] + np.arange(near.shape[2])]]


def _candidates(
    wanted: np.ndarray,
    corners_m: np.ndarray,
    kind: np.ndarray,
    table: MatchTable,
    near: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and moves, ascending, among which each row's nearest few surely are."""
    spread = _spread(wanted, table.reach_m[kind])
    square = (spread**2).sum(axis=-1)
    spread = np.column_stack([spread, np.ones_like(square)])
    ends = np.searchsorted(kind, np.arange(4))
    found = []
    for number in np.flatnonzero(np.diff(ends)):
        rows = slice(ends[number], ends[number + 1])
        gap = spread[rows] @ table.weights[number]  # [row, move], less square
        guess = near[number, gap.argmin(axis=1)]  # [row, few]
        guess_m = _mean_gap(table.corners_m[number, guess], corners_m[rows, None])
        guess_m = guess_m.max(axis=1)

        # The nearest few are no farther than any few at most, their spreads 1.42 times.
        twice = (2 * guess_m**2).astype(np.float32)
        # Sixty roundings of a float32, relative to moves about as long as the one wanted.
        slack = np.float32(5e-6) * (square[rows] + twice)
        flat = np.flatnonzero(gap <= (twice - square[rows] + slack)[:, None])
        found.append(flat + ends[number] * gap.shape[1])
    return np.divmod(np.concatenate(found), table.vocabulary.num_motion_tokens)


def _mean_gap(one_m: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    """Return the mean distance of four corners; arrays are [..., 8]: all x, then all y."""
    away_m = np.moveaxis((one_m - other_m) ** 2, -1, 0)
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
