"""The agent matrix: presence, motion token and pose of every agent at every token step.

Matching rolls forward (SPEC 2.3): each motion token starts where the last *chosen* one
ended, not where the log says the agent was. The next token corrects the
error of the one before, so errors never add up. A chain of tokens starts at the pose an
agent is inserted with, and again after a gap in the log.

Encoding and decoding go through the same ``_advance`` and ``_place_inserted`` on arrays of
the same shape, so that what is decoded equals what was encoded bit for bit.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16

from infgen.clock import CLOCK, Clock
from infgen.geometry import to_world
from infgen.tokens.grid import Grid, encode_cell, to_grid
from infgen.tokens.insertion import (
    Insertions,
    decode_insertions,
    encode_insertions,
    insertion_order,
    join_insertions,
)
from infgen.tokens.motion_tokens import MatchTable, advance, nearest_motion_tokens
from infgen.tokens.presence import gap_ends, observed_tokens, presence_states, seen_tokens
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
    SceneTokens,
)
from infgen.tokens.tracks import Paths
from infgen.tokens.vocabulary import MotionVocabulary


@dataclass(frozen=True, slots=True)
class AgentMatrix:
    """One row per agent, one column per token. Fields as in ``SceneTokens``."""

    agent_type: Int8[np.ndarray, " agent"]
    pose: Float32[np.ndarray, "agent token 3"]
    motion_token: Int16[np.ndarray, "agent token"]
    presence: Int8[np.ndarray, "agent token"]
    observed: Bool[np.ndarray, "agent token"]
    cell: Int16[np.ndarray, "agent token"]


@dataclass(frozen=True, slots=True)
class Anchors:
    """Logged poses that chains of motion tokens start from, at the end of ``token``."""

    agent: Int16[np.ndarray, " anchor"]
    token: Int16[np.ndarray, " anchor"]
    pose: Float32[np.ndarray, "anchor 3"]

    def at(self, token: int) -> "Anchors":
        """Return the anchors of one token."""
        rows = np.flatnonzero(self.token == token)
        return Anchors(self.agent[rows], self.token[rows], self.pose[rows])


def match_agents(
    paths: Paths, table: MatchTable, grid: Grid, order: str
) -> tuple[AgentMatrix, Insertions, Anchors]:
    """Tokenize every agent: its insertion and the motion tokens that follow its path.

    Args:
        paths: Agents at the borders of tokens.
        table: Moves to choose from.
        grid: Cells and heading bins of entries.
        order: Order of inserted agents within a token: ``distance`` or ``bearing``.
    """
    seen = seen_tokens(paths.valid)
    presence = presence_states(seen)
    observed = observed_tokens(seen, presence)
    anchors = _find_anchors(paths, seen, presence)

    pose = np.zeros_like(paths.pose[:, 0])
    poses, motion_tokens, insertions = [], [], []
    for token in range(seen.shape[1]):
        logged = paths.pose[:, token + 1]
        motion_token = _nearest_motion_tokens(
            logged, pose, paths.agent_type, observed[:, token], table
        )
        pose = _advance(
            pose, paths.agent_type, motion_token, anchors.at(token), table.vocabulary
        )
        inserted = np.flatnonzero(presence[:, token] == Presence.INSERTED)
        motion_token[inserted] = FIRST_MOTION_TOKEN
        if len(inserted):
            inserted = _insertion_order(inserted, logged, pose[paths.ego], paths.ego, order)
            new = encode_insertions(
                token, inserted, logged[inserted], pose[paths.ego], grid
            )
            pose = _place_inserted(pose, new, paths.ego, grid)
            insertions.append(new)
        poses.append(pose)
        motion_tokens.append(motion_token)

    joined = join_insertions(insertions)
    path = _zero_where_absent(poses, presence)
    matrix = AgentMatrix(
        agent_type=paths.agent_type,
        pose=path,
        motion_token=np.stack(motion_tokens, axis=1),
        presence=presence,
        observed=observed,
        cell=_encode_cells(path, paths.ego, observed, joined, grid),
    )
    return matrix, joined, anchors


def decode_agents(
    agent_type: Int8[np.ndarray, " agent"],
    motion_token: Int16[np.ndarray, "agent token"],
    presence: Int8[np.ndarray, "agent token"],
    insertions: Insertions,
    anchors: Anchors,
    ego: int,
    vocabulary: MotionVocabulary,
    grid: Grid,
) -> AgentMatrix:
    """Rebuild the agent matrix from its tokens. Inverse of ``match_agents``.

    Motion tokens, presence, insertions and anchors determine all other fields.
    """
    pose = np.zeros((len(agent_type), 3), dtype=np.float32)
    poses = []
    for token in range(motion_token.shape[1]):
        pose = _advance(
            pose, agent_type, motion_token[:, token], anchors.at(token), vocabulary
        )
        new = insertions.at(token)
        if len(new.agent):
            pose = _place_inserted(pose, new, ego, grid)
        poses.append(pose)
    path, observed = _zero_where_absent(poses, presence), motion_token >= 0
    cell = _encode_cells(path, ego, observed, insertions, grid)
    return AgentMatrix(agent_type, path, motion_token, presence, observed, cell)


def agent_matrix(tokens: SceneTokens) -> AgentMatrix:
    """Return the agent matrix of a tokenized scene."""
    return AgentMatrix(
        agent_type=tokens.agent_type,
        pose=tokens.pose,
        motion_token=tokens.motion_token,
        presence=tokens.presence,
        observed=tokens.observed,
        cell=tokens.cell,
    )


def decode_tracks(
    matrix: AgentMatrix, vocabulary: MotionVocabulary, clock: Clock = CLOCK
) -> tuple[Float32[np.ndarray, "agent step 3"], Bool[np.ndarray, "agent step"]]:
    """Decode motion tokens to poses at every 0.1 s step (SPEC 2.4).

    The first decoded pose is the one at which the agent is inserted: the end of its first
        token.

    Returns:
        Poses [agent, step, 3], zero where unknown, and whether they are known.
    """
    agents, tokens = matrix.motion_token.shape
    steps = np.zeros((agents, tokens, clock.steps_per_token, 3), dtype=np.float32)
    known = np.zeros(steps.shape[:3], dtype=bool)

    before, after = matrix.pose[:, :-1], matrix.motion_token[:, 1:]
    path = vocabulary.path[matrix.agent_type[:, None], np.maximum(after, 0), 1:]
    moving = after >= 0
    steps[:, 1:][moving] = to_world(path[moving], before[moving][:, None])
    known[:, 1:][moving] = True

    # Poses at a token's end: insertions, and the first pose after a gap.
    placed = matrix.presence == Presence.INSERTED
    placed[:, :-1] |= moving & (matrix.motion_token[:, :-1] == NO_MOTION_TOKEN)
    steps[placed, -1] = matrix.pose[placed]
    known[placed, -1] = True
    first = ((0, 0), (1, 0))
    return (
        np.pad(steps.reshape(agents, -1, 3), (*first, (0, 0))),
        np.pad(known.reshape(agents, -1), first),
    )


def _find_anchors(paths: Paths, seen: np.ndarray, presence: np.ndarray) -> Anchors:
    anchored = gap_ends(seen, presence)
    anchored[paths.ego, 0] = True
    token, agent = np.nonzero(anchored.T)
    pose = paths.pose[agent, token + 1]
    return Anchors(agent.astype(np.int16), token.astype(np.int16), pose)


def _nearest_motion_tokens(
    logged: np.ndarray,
    pose: np.ndarray,
    agent_type: np.ndarray,
    observed: np.ndarray,
    table: MatchTable,
) -> np.ndarray:
    motion_token = np.full(len(pose), NO_MOTION_TOKEN, dtype=np.int16)
    rows = np.flatnonzero(observed)
    motion_token[rows] = nearest_motion_tokens(
        logged[rows], pose[rows], agent_type[rows], table
    )
    return motion_token


def _advance(
    pose: np.ndarray,
    agent_type: np.ndarray,
    motion_token: np.ndarray,
    anchors: Anchors,
    vocabulary: MotionVocabulary,
) -> np.ndarray:
    pose = advance(pose, agent_type, motion_token, vocabulary)
    pose[anchors.agent] = anchors.pose
    return pose


def _insertion_order(
    inserted: np.ndarray, logged: np.ndarray, ego_pose: np.ndarray, ego: int, order: str
) -> np.ndarray:
    """Order the rows of inserted agents; the ego is always the first."""
    inserted = inserted[insertion_order(logged[inserted], ego_pose, order)]
    return inserted[np.argsort(inserted != ego, kind="stable")]


def _place_inserted(
    pose: np.ndarray, insertions: Insertions, ego: int, grid: Grid
) -> np.ndarray:
    """Set the poses of inserted agents; the ego takes its pose from its anchor."""
    pose, others = pose.copy(), insertions.agent != ego
    entered = decode_insertions(insertions, pose[ego], grid)
    pose[insertions.agent[others]] = entered[others]
    return pose


def _zero_where_absent(poses: list[np.ndarray], presence: np.ndarray) -> np.ndarray:
    """Stack poses [agent, token, 3]; absent agents get zeros."""
    path = np.stack(poses, axis=1)
    path[presence == Presence.ABSENT] = 0
    return path


def _encode_cells(
    pose: np.ndarray, ego: int, observed: np.ndarray, insertions: Insertions, grid: Grid
) -> np.ndarray:
    """Return the cell of every observed agent; insertions keep the cell they encode."""
    cell = encode_cell(to_grid(pose[..., :2], pose[ego]), grid)
    cell = np.where(observed, cell, np.int16(NO_CELL))
    cell[insertions.agent, insertions.token] = insertions.cell
    return cell
