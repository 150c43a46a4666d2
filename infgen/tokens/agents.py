"""The agent matrix: every agent's life, moves and poses, half second by half second.

Matching rolls forward (SPEC 2.3): each move starts where the last *chosen* one ended, not
where the log says the agent was. An error of one move is seen, and corrected, by the next;
it never adds up. A chain starts at the pose an agent enters with, and anew after a gap.

Encoding and decoding go through the same ``_move_on`` and ``_place`` on arrays of the same
shape, so that what is decoded equals what was encoded bit for bit.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16

from infgen.clock import CLOCK, Clock
from infgen.geometry import to_world
from infgen.tokens.grid import Grid, encode_cell, to_grid
from infgen.tokens.insertion import (
    Entries,
    decode_entries,
    encode_entries,
    insertion_order,
    join_entries,
)
from infgen.tokens.motion_tokens import MoveTable, advance, nearest_moves
from infgen.tokens.presence import live, observe, resumes, seen_tokens
from infgen.tokens.scene_tokens import FIRST_MOVE, NO_CELL, NO_MOVE, Presence, SceneTokens
from infgen.tokens.tracks import Paths
from infgen.tokens.vocabulary import MotionVocabulary


@dataclass(frozen=True, slots=True)
class AgentMatrix:
    """One row per agent, one column per token. Fields as in ``SceneTokens``."""

    kind: Int8[np.ndarray, " agent"]
    pose: Float32[np.ndarray, "agent token 3"]
    move: Int16[np.ndarray, "agent token"]
    presence: Int8[np.ndarray, "agent token"]
    observed: Bool[np.ndarray, "agent token"]
    cell: Int16[np.ndarray, "agent token"]


@dataclass(frozen=True, slots=True)
class Anchors:
    """Where chains of moves start from the log: at the end of ``token``, at ``pose``."""

    agent: Int16[np.ndarray, " anchor"]
    token: Int16[np.ndarray, " anchor"]
    pose: Float32[np.ndarray, "anchor 3"]

    def at(self, token: int) -> "Anchors":
        """Return the anchors of one token."""
        rows = np.flatnonzero(self.token == token)
        return Anchors(self.agent[rows], self.token[rows], self.pose[rows])


def match_agents(
    paths: Paths, table: MoveTable, grid: Grid, order: str
) -> tuple[AgentMatrix, Entries, Anchors]:
    """Write every agent's path as an entry and the chain of moves that follows it.

    Args:
        paths: Agents at the borders of tokens.
        table: Moves to choose from.
        grid: Cells and heading bins of entries.
        order: Order of newcomers within a token: ``distance`` or ``bearing``.
    """
    seen = seen_tokens(paths.valid)
    presence = live(seen)
    observed = observe(seen, presence)
    anchors = _find_anchors(paths, seen, presence)

    pose = np.zeros_like(paths.pose[:, 0])
    poses, moves, entries = [], [], []
    for token in range(seen.shape[1]):
        logged = paths.pose[:, token + 1]
        move = _choose_moves(logged, pose, paths.kind, observed[:, token], table)
        pose = _move_on(pose, paths.kind, move, anchors.at(token), table.codebook)
        coming = np.flatnonzero(presence[:, token] == Presence.ENTERING)
        move[coming] = FIRST_MOVE
        if len(coming):
            coming = _in_order(coming, logged, pose[paths.ego], paths.ego, order)
            new = encode_entries(token, coming, logged[coming], pose[paths.ego], grid)
            pose = _place(pose, new, paths.ego, grid)
            entries.append(new)
        poses.append(pose)
        moves.append(move)

    joined = join_entries(entries)
    path = _where_present(poses, presence)
    matrix = AgentMatrix(
        kind=paths.kind,
        pose=path,
        move=np.stack(moves, axis=1),
        presence=presence,
        observed=observed,
        cell=_cells(path, paths.ego, observed, joined, grid),
    )
    return matrix, joined, anchors


def replay(
    kind: Int8[np.ndarray, " agent"],
    move: Int16[np.ndarray, "agent token"],
    presence: Int8[np.ndarray, "agent token"],
    entries: Entries,
    anchors: Anchors,
    ego: int,
    codebook: MotionVocabulary,
    grid: Grid,
) -> AgentMatrix:
    """Move agents along their moves from where they enter. Inverse of ``match_agents``.

    Everything ``match_agents`` found follows from its moves, presence, entries and anchors.
    """
    pose = np.zeros((len(kind), 3), dtype=np.float32)
    poses = []
    for token in range(move.shape[1]):
        pose = _move_on(pose, kind, move[:, token], anchors.at(token), codebook)
        new = entries.at(token)
        if len(new.agent):
            pose = _place(pose, new, ego, grid)
        poses.append(pose)
    path, observed = _where_present(poses, presence), move >= 0
    cell = _cells(path, ego, observed, entries, grid)
    return AgentMatrix(kind, path, move, presence, observed, cell)


def matrix_of(tokens: SceneTokens) -> AgentMatrix:
    """Return the agent matrix of a tokenized scene."""
    return AgentMatrix(
        kind=tokens.kind,
        pose=tokens.pose,
        move=tokens.move,
        presence=tokens.presence,
        observed=tokens.observed,
        cell=tokens.cell,
    )


def decode_tracks(
    matrix: AgentMatrix, codebook: MotionVocabulary, clock: Clock = CLOCK
) -> tuple[Float32[np.ndarray, "agent step 3"], Bool[np.ndarray, "agent step"]]:
    """Draw agents at every 0.1 s step along the paths of their moves (SPEC 2.4).

    An agent is drawn from the pose it enters with, the end of its first token, on.

    Returns:
        Poses [agent, step, 3], zero where unknown, and whether they are known.
    """
    agents, tokens = matrix.move.shape
    steps = np.zeros((agents, tokens, clock.steps_per_token, 3), dtype=np.float32)
    known = np.zeros(steps.shape[:3], dtype=bool)

    before, after = matrix.pose[:, :-1], matrix.move[:, 1:]
    path = codebook.path[matrix.kind[:, None], np.maximum(after, 0), 1:]
    moving = after >= 0
    steps[:, 1:][moving] = to_world(path[moving], before[moving][:, None])
    known[:, 1:][moving] = True

    # Pose at a token's end: where agents enter, and where chains start anew.
    placed = matrix.presence == Presence.ENTERING
    placed[:, :-1] |= moving & (matrix.move[:, :-1] == NO_MOVE)
    steps[placed, -1] = matrix.pose[placed]
    known[placed, -1] = True
    first = ((0, 0), (1, 0))
    return (
        np.pad(steps.reshape(agents, -1, 3), (*first, (0, 0))),
        np.pad(known.reshape(agents, -1), first),
    )


def _find_anchors(paths: Paths, seen: np.ndarray, presence: np.ndarray) -> Anchors:
    anchored = resumes(seen, presence)
    anchored[paths.ego, 0] = True
    token, agent = np.nonzero(anchored.T)
    pose = paths.pose[agent, token + 1]
    return Anchors(agent.astype(np.int16), token.astype(np.int16), pose)


def _choose_moves(
    logged: np.ndarray,
    pose: np.ndarray,
    kind: np.ndarray,
    observed: np.ndarray,
    table: MoveTable,
) -> np.ndarray:
    move = np.full(len(pose), NO_MOVE, dtype=np.int16)
    rows = np.flatnonzero(observed)
    move[rows] = nearest_moves(logged[rows], pose[rows], kind[rows], table)
    return move


def _move_on(
    pose: np.ndarray,
    kind: np.ndarray,
    move: np.ndarray,
    anchors: Anchors,
    codebook: MotionVocabulary,
) -> np.ndarray:
    pose = advance(pose, kind, move, codebook)
    pose[anchors.agent] = anchors.pose
    return pose


def _in_order(
    coming: np.ndarray, logged: np.ndarray, ego_pose: np.ndarray, ego: int, order: str
) -> np.ndarray:
    """Order the rows of newcomers; the ego is always the first."""
    coming = coming[insertion_order(logged[coming], ego_pose, order)]
    return coming[np.argsort(coming != ego, kind="stable")]


def _place(pose: np.ndarray, entries: Entries, ego: int, grid: Grid) -> np.ndarray:
    """Put newcomers where their entries say, but for the ego: its anchor says where."""
    pose, others = pose.copy(), entries.agent != ego
    entered = decode_entries(entries, pose[ego], grid)
    pose[entries.agent[others]] = entered[others]
    return pose


def _where_present(poses: list[np.ndarray], presence: np.ndarray) -> np.ndarray:
    """Return poses [agent, token, 3]; zero for who is not there."""
    path = np.stack(poses, axis=1)
    path[presence == Presence.ABSENT] = 0
    return path


def _cells(
    pose: np.ndarray, ego: int, observed: np.ndarray, entries: Entries, grid: Grid
) -> np.ndarray:
    """Return the cell of every agent seen; who enters is in the cell of its entry."""
    cell = encode_cell(to_grid(pose[..., :2], pose[ego]), grid)
    cell = np.where(observed, cell, np.int16(NO_CELL))
    cell[entries.agent, entries.token] = entries.cell
    return cell
