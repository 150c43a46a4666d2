"""Noise on tokens to learn from, and the moves that lead back (SPEC 2.3, 1.3).

Who only ever sees logs never sees what its own small errors lead to. So agents are led off
their ways a little: at each half second an agent takes not the move that ends nearest to
where it should be, but one of the few nearest, and goes on from where that leads. What is
to be learned is always the nearest, from where the agent has come to. As every draw is near
to the true pose, errors never add up: agents stray as far as a few neighbouring moves are
apart. Who stands is left alone: it would learn to tremble, and that nobody who has begun to
move goes on.

Where an agent should be is its quantised pose, which is all that tokens keep of the log. It
is within centimetres of the log's own.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16

from infgen.config import TrainSettings
from infgen.tokens.codebook import MotionCodebook, RoadCodebook
from infgen.tokens.moves import MoveTable, advance, make_move_table, nearest_few

FARTHEST_M = 1.0
"""No draw leads farther from where an agent should be: where moves are rare, the second
nearest may end metres away ..."""
FARTHEST_SHARE = 1 / 8
"""... nor farther than this share of the agent's way in the half second."""


@dataclass(frozen=True, eq=False, slots=True)
class Noise:
    """How tokens are disturbed.

    Attributes:
        table: The moves.
        moves: How many moves each is drawn from, all equally likely; 0 for none disturbed.
        share: Of the moves that are drawn; the others are the nearest.
        near_roads: For each map shape those that it is drawn from, itself the first.
    """

    table: MoveTable
    moves: int
    share: float
    near_roads: Int16[np.ndarray, "road near"]


class Strays(NamedTuple):
    """Agents off their ways: fields [agent, token] as in ``SceneTokens``.

    Attributes:
        move: The moves taken ...
        pose: ... where they lead ...
        label: ... and the moves that would have led nearest to where agents should be.
        off: Where an agent is not where it should be.
    """

    move: np.ndarray
    pose: np.ndarray
    label: np.ndarray
    off: np.ndarray


def make_noise(
    settings: TrainSettings, motion: MotionCodebook, roads: RoadCodebook
) -> Noise | None:
    """Make the noise that settings ask for; None if they ask for none.

    In a codebook that has fewer tokens, draws are from all of them.
    """
    if not settings.noise_moves and not settings.noise_roads:
        return None
    return Noise(
        table=make_move_table(motion),
        moves=min(settings.noise_moves, motion.num_moves),
        share=settings.noise_share,
        near_roads=_near_roads(roads, max(1, settings.noise_roads)),
    )


def lead_astray(
    kind: Int8[np.ndarray, " agent"],
    pose: Float32[np.ndarray, "agent token 3"],
    move: Int16[np.ndarray, "agent token"],
    moving: Bool[np.ndarray, "agent token"],
    noise: Noise,
    random: np.random.Generator,
) -> Strays:
    """Walk agents anew along moves that are drawn.

    Args:
        kind: ``AgentKind``.
        pose: Where each agent should be at each token's end.
        move: What led it there.
        moving: Tokens at which it goes by moves that may be drawn, none of them the first.
            At all others it is where it should be, and starts from there.
        noise: How to draw.
        random: Source of the draws.
    """
    turn = random.integers(noise.moves, size=moving.shape)
    turn[random.random(moving.shape) >= noise.share] = 0
    strays = Strays(move.copy(), pose.copy(), move.copy(), np.zeros_like(moving))
    for token in range(1, moving.shape[1]):
        rows = np.flatnonzero(moving[:, token])
        before, wanted = strays.pose[rows, token - 1], pose[rows, token]
        few = nearest_few(wanted, before, kind[rows], noise.table, noise.moves)
        nearest, taken = few[:, 0], few[np.arange(len(rows)), turn[rows, token]]
        ends = advance(before, kind[rows], taken, noise.table.codebook)

        way_m = np.hypot(*(wanted - pose[rows, token - 1])[:, :2].T)
        away_m = np.hypot(*(ends - wanted)[:, :2].T)
        far = np.flatnonzero(away_m > np.minimum(FARTHEST_M, FARTHEST_SHARE * way_m))
        taken[far] = nearest[far]
        ends[far] = advance(before[far], kind[rows[far]], taken[far], noise.table.codebook)

        # Who is where it should be and takes the move it took stays so to the last bit.
        off = strays.off[rows, token - 1] | (taken != move[rows, token])
        strays.label[rows, token], strays.move[rows, token] = nearest, taken
        strays.pose[rows, token] = np.where(off[:, None], ends, wanted)
        strays.off[rows, token] = off
    return strays


def exchange_roads(
    token: Int16[np.ndarray, " road"],
    fixed: Bool[np.ndarray, " road"],
    noise: Noise,
    random: np.random.Generator,
) -> Int16[np.ndarray, " road"]:
    """Draw each road token's shape from those near to it, but for the ``fixed``."""
    turn = random.integers(noise.near_roads.shape[1], size=token.shape)
    return np.where(fixed, token, noise.near_roads[token, turn])


def _near_roads(codebook: RoadCodebook, count: int) -> Int16[np.ndarray, "road near"]:
    """Return for each shape the nearest, as pieces are matched, itself the first."""
    points_m = codebook.sample_m.reshape(codebook.num_roads, -1)
    square_m2 = ((points_m[:, None] - points_m) ** 2).sum(axis=-1)
    np.fill_diagonal(square_m2, -1.0)
    return np.argsort(square_m2, axis=1, kind="stable")[:, :count].astype(np.int16)
