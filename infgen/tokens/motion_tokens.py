"""From poses to motion tokens and back: the nearest row of a vocabulary, and its end pose.

The distance of two motion tokens is the mean distance of the corners of a box at their ends
(SPEC 2.1).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int16, Int64

from infgen.geometry import box_corners, to_local, to_world
from infgen.tokens.vocabulary import MotionVocabulary

_BLOCK_ROWS = 512
"""Keeps the table of distances (rows x motion tokens) within 4 MiB."""


@dataclass(frozen=True, eq=False, slots=True)
class MatchTable:
    """A motion vocabulary laid out for matching.

    The *spread* of a pose is the point (x, y, r cos heading, r sin heading), where r is
    half the diagonal of the agent type's box. The distance of two spreads is the root mean
    square distance of the corners. As opposite corners turn opposite ways, the mean
    distance is at most that, and at least 1 / sqrt(2) of it: so the nearest spread tells
    which few motion tokens are worth measuring.

    Attributes:
        vocabulary: The motion tokens.
        reach_m: Half the diagonal of each agent type's box.
        weights: One column per motion token and agent type: the spread of its end times -2,
            then its squared length. The product with a spread and a one is the squared
            distance of the two less the square of the one.
        corners_m: Corners of the box at each motion token's end: x of the four, then y.
    """

    vocabulary: MotionVocabulary
    reach_m: Float32[np.ndarray, " 3"]
    weights: Float32[np.ndarray, "3 5 motion"]
    corners_m: Float64[np.ndarray, "3 motion 8"]


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


@lru_cache(maxsize=16)
def neighbour_reach_m(
    table: MatchTable, count: int
) -> Float64[np.ndarray, "3 motion count"]:
    """Return how far from each motion token's spread those of the nearest few are.

    Args:
        table: The motion tokens.
        count: How many, itself (or an equal one) included, nearest first.
    """
    found = []
    for corners_m in table.corners_m:
        # A quarter of the squared distance of all corners is that of the spreads.
        square = (corners_m**2).sum(axis=1)
        gap = square[:, None] + square - 2 * corners_m @ corners_m.T
        few = np.sort(np.partition(gap, count - 1, axis=1)[:, :count], axis=1)
        found.append(np.sqrt(few.clip(min=0) / 4) + 1e-5)  # With room for rounding.
    return np.stack(found)


def nearest_motion_tokens(
    target: Float32[np.ndarray, "row 3"],
    pose: Float32[np.ndarray, "row 3"],
    agent_type: Int8[np.ndarray, " row"],
    table: MatchTable,
) -> Int16[np.ndarray, " row"]:
    """Find the motion token from each pose that ends nearest to each target.

    Nearest is the least mean distance of the corners of the agent type's box; of equally
    near ones the first.

    Args:
        target: Where each agent is at the end of the motion token.
        pose: Where the motion token starts.
        agent_type: ``AgentType`` of each agent.
        table: The motion tokens to choose from.
    """
    rank = np.zeros(len(agent_type), dtype=np.int64)
    return ranked_motion_tokens(target, pose, agent_type, rank, table)[0]


def ranked_motion_tokens(
    target: Float32[np.ndarray, "row 3"],
    pose: Float32[np.ndarray, "row 3"],
    agent_type: Int8[np.ndarray, " row"],
    rank: Int64[np.ndarray, " row"],
    table: MatchTable,
) -> tuple[Int16[np.ndarray, " row"], Int16[np.ndarray, " row"]]:
    """Find the motion token that ends nearest to each target, and the one of a rank.

    Distance and arguments are those of ``nearest_motion_tokens``; ``rank`` is the number
    of motion tokens that are nearer, less than the vocabulary holds.
    """
    order = np.argsort(agent_type, kind="stable")
    found = np.empty((2, len(order)), dtype=np.int16)
    for start in range(0, len(order), _BLOCK_ROWS):
        rows = order[start : start + _BLOCK_ROWS]
        wanted = to_local(target[rows], pose[rows])
        found[:, rows] = _ranked(wanted, agent_type[rows], rank[rows], table)
    return found[0], found[1]


def advance(
    pose: Float32[np.ndarray, "agent 3"],
    agent_type: Int8[np.ndarray, " agent"],
    motion_token: Int16[np.ndarray, " agent"],
    vocabulary: MotionVocabulary,
) -> Float32[np.ndarray, "agent 3"]:
    """Advance agents by one motion token; those without one (negative) stay."""
    end = vocabulary.end_pose[agent_type, np.maximum(motion_token, 0)]
    return np.where(motion_token[:, None] >= 0, to_world(end, pose), pose)


def follow(
    target: Float32[np.ndarray, "agent 3"],
    pose: Float32[np.ndarray, "agent 3"],
    agent_type: Int8[np.ndarray, " agent"],
    table: MatchTable,
) -> tuple[Int16[np.ndarray, " agent"], Float32[np.ndarray, "agent 3"]]:
    """Encode one token step of externally controlled agents as motion tokens.

    Called once per token step with the pose it returned before, the chain of motion tokens
    follows the targets, and an error of one motion token is corrected by the next.

    Returns:
        The motion tokens, and the poses they lead to.
    """
    motion_token = nearest_motion_tokens(target, pose, agent_type, table)
    return motion_token, advance(pose, agent_type, motion_token, table.vocabulary)


def _ranked(
    wanted: np.ndarray, agent_type: np.ndarray, rank: np.ndarray, table: MatchTable
) -> np.ndarray:
    """Return motion tokens [2, row], nearest and of a rank; ``agent_type`` ascends."""
    corners_m = _corners(wanted, table.vocabulary.size_lw_m[agent_type])  # [row, 8]
    row, motion_token = _candidates(wanted, corners_m, agent_type, rank, table)
    gap_m = _mean_gap(table.corners_m[agent_type[row], motion_token], corners_m[row])

    first = np.searchsorted(row, np.arange(len(wanted) + 1))
    least = np.flatnonzero(gap_m == np.minimum.reduceat(gap_m, first[:-1])[row])
    nearest = least[np.searchsorted(row[least], np.arange(len(wanted)))]
    chosen, some = nearest.copy(), np.flatnonzero(rank)
    if len(some):
        size = np.diff(first)[some]
        place = np.arange(size.max())
        padded_m = np.full((len(some), len(place)), np.inf)
        there = place < size[:, None]
        padded_m[there] = gap_m[np.repeat(rank > 0, np.diff(first))]
        chosen[some] = first[some] + _place_of_rank(padded_m, rank[some])
    return motion_token[np.stack([nearest, chosen])]


def _place_of_rank(values: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Return where in each row the value of a rank is; of equal ones the first is less."""
    value = np.sort(values, axis=1)[np.arange(len(rank)), rank, None]
    skipped = rank - (values < value).sum(axis=1)
    return ((values == value).cumsum(axis=1) > skipped[:, None]).argmax(axis=1)


def _candidates(
    wanted: np.ndarray,
    corners_m: np.ndarray,
    agent_type: np.ndarray,
    rank: np.ndarray,
    table: MatchTable,
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and motion tokens, ascending, sure to hold those up to a rank."""
    spread = _spread(wanted, table.reach_m[agent_type])
    square = (spread**2).sum(axis=-1)
    spread = np.column_stack([spread, np.ones_like(square)])
    ends = np.searchsorted(agent_type, np.arange(4))
    found = []
    for number in np.flatnonzero(np.diff(ends)):
        rows = slice(ends[number], ends[number + 1])
        gap = spread[rows] @ table.weights[number]  # [row, motion], less square
        guess = gap.argmin(axis=1)
        most_m = _most_m(corners_m[rows], guess, rank[rows], int(number), table)

        # Those up to the rank are no farther than that, their spreads 1.42 times.
        twice = (2 * most_m**2).astype(np.float32)
        # Sixty roundings of a float32, relative to tokens about as long as the one wanted.
        slack = np.float32(5e-6) * (square[rows] + twice)
        flat = np.flatnonzero(gap <= (twice - square[rows] + slack)[:, None])
        found.append(flat + ends[number] * gap.shape[1])
    return np.divmod(np.concatenate(found), table.vocabulary.num_motion_tokens)


def _most_m(
    corners_m: np.ndarray,
    guess: np.ndarray,
    rank: np.ndarray,
    number: int,
    table: MatchTable,
) -> np.ndarray:
    """Return distances that the motion tokens up to a rank do not exceed.

    The guess itself is as far as it is; those around it are, by their spreads, no farther
    from the target than from the guess and the guess from the target.
    """
    ends_m = table.corners_m[number, guess]
    most_m = _mean_gap(ends_m, corners_m)
    some = np.flatnonzero(rank)
    if len(some):
        count = 1 << int(rank.max()).bit_length()  # A few tables do for all ranks.
        count = min(count, table.vocabulary.num_motion_tokens)
        reach_m = neighbour_reach_m(table, count)[number]
        away_m = np.sqrt(((ends_m[some] - corners_m[some]) ** 2).sum(axis=1) / 4)
        most_m[some] = away_m + reach_m[guess[some], rank[some]]
    return most_m


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
