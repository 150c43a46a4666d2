"""The interleaved sequence: the agent matrix as one sequence of tokens, and back.

Each token step holds, in this order (SPEC 3.4): ``MOTION`` of every observed agent that was
present before, from near to far of the ego; ``KEEP`` or ``REMOVE`` of every agent that was
present before, in the same order; ``ADD, POSITION, HEADING, AGENT_TYPE`` of each inserted
agent; ``BEGIN_MOTION``. Distances are those at the end of the step before, so the order
reveals nothing of the future. An agent present for its first token step only has a
``REMOVE`` right after its ``AGENT_TYPE``.
"""

from typing import NamedTuple

import numpy as np

from infgen.tokens.agents import AgentMatrix, Anchors, decode_agents
from infgen.tokens.grid import make_grid
from infgen.tokens.insertion import Insertions
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_MOTION_TOKEN,
    Presence,
    SceneTokens,
    TokenType,
)
from infgen.tokens.settings import TokenSettings
from infgen.tokens.vocabulary import MotionVocabulary

_NO_AGENT = -1
_MOTION, _CONTROLS, _INSERTIONS, _END = range(4)


class TokenSequence(NamedTuple):
    """Tokens of the sequence; sorted by ``token``, ``phase``, ``rank`` when written."""

    word: np.ndarray
    value: np.ndarray
    agent: np.ndarray
    token: np.ndarray
    phase: np.ndarray
    rank: np.ndarray


def encode_sequence(matrix: AgentMatrix, insertions: Insertions, ego: int) -> TokenSequence:
    """Write the agent matrix as the interleaved sequence."""
    parts = [
        *_agent_tokens(matrix, ego),
        *_insertion_tokens(matrix, insertions),
        _begin_motion_tokens(matrix.motion_token.shape[1]),
    ]
    sequence = TokenSequence(
        *(np.concatenate(columns) for columns in zip(*parts, strict=True))
    )
    order = np.lexsort((sequence.rank, sequence.phase, sequence.token))
    return TokenSequence(*(column[order] for column in sequence))


def decode_sequence(
    tokens: SceneTokens, vocabulary: MotionVocabulary, settings: TokenSettings
) -> AgentMatrix:
    """Read the agent matrix back from the sequence. Inverse of ``encode_sequence``.

    Nothing of ``tokens`` is read but the sequence (``sequence_...``), the
    ego's row, the insertions' offsets and residuals, and the anchors.
    """
    word, token, agent = tokens.sequence_type, tokens.sequence_step, tokens.sequence_agent
    value, added = tokens.sequence_value, word == TokenType.ADD
    shape = int(added.sum()), int((word == TokenType.BEGIN_MOTION).sum())

    presence = np.full(shape, Presence.ABSENT, dtype=np.int8)
    for said, meant in (
        (TokenType.KEEP, Presence.PRESENT),
        (TokenType.REMOVE, Presence.REMOVED),
        (TokenType.ADD, Presence.INSERTED),
    ):
        rows = word == said
        presence[agent[rows], token[rows]] = meant
    motion_token = np.full(shape, NO_MOTION_TOKEN, dtype=np.int16)
    rows = word == TokenType.MOTION
    motion_token[agent[rows], token[rows]] = value[rows]
    motion_token[agent[added], token[added]] = FIRST_MOTION_TOKEN
    agent_type = np.zeros(shape[0], dtype=np.int8)
    rows = word == TokenType.AGENT_TYPE
    agent_type[agent[rows]] = value[rows]

    insertions = Insertions(
        token=token[added].astype(np.int16),
        agent=agent[added],
        cell=value[word == TokenType.POSITION],
        offset_m=tokens.insertion_offset_m,
        heading=value[word == TokenType.HEADING],
        residual_rad=tokens.insertion_residual_rad,
    )
    anchors = Anchors(tokens.anchor_agent, tokens.anchor_token, tokens.anchor_pose)
    grid = make_grid(settings)
    return decode_agents(
        agent_type,
        motion_token,
        presence,
        insertions,
        anchors,
        tokens.ego,
        vocabulary,
        grid,
    )


def _agent_tokens(matrix: AgentMatrix, ego: int) -> list[TokenSequence]:
    """Write motion and control tokens of the agents that were present before."""
    away_m = matrix.pose[:, :-1, :2] - matrix.pose[ego, :-1, :2]
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])  # [agent, token - 1]
    order = np.argsort(distance_m, axis=0, kind="stable")
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(len(rank))[:, None], axis=0)

    presence, motion_token = matrix.presence[:, 1:], matrix.motion_token[:, 1:]
    agent, token = np.nonzero(motion_token >= 0)
    motion_tokens = _make_tokens(
        TokenType.MOTION,
        motion_token[agent, token],
        agent,
        token + 1,
        _MOTION,
        rank[agent, token],
    )
    here = (presence == Presence.PRESENT) | (presence == Presence.REMOVED)
    agent, token = np.nonzero(here)
    said = np.where(
        presence[agent, token] == Presence.REMOVED, TokenType.REMOVE, TokenType.KEEP
    )
    controls = _make_tokens(
        said, np.zeros_like(agent), agent, token + 1, _CONTROLS, rank[agent, token]
    )
    return [motion_tokens, controls]


def _insertion_tokens(matrix: AgentMatrix, insertions: Insertions) -> list[TokenSequence]:
    """Write the tokens of each insertion together, in the order of the insertions."""
    agent, token = insertions.agent.astype(np.int64), insertions.token.astype(np.int64)
    turn = 5 * np.arange(len(agent))
    zero = np.zeros_like(agent)
    said = [
        (TokenType.ADD, zero),
        (TokenType.POSITION, insertions.cell),
        (TokenType.HEADING, insertions.heading),
        (TokenType.AGENT_TYPE, matrix.agent_type[agent]),
    ]
    parts = [
        _make_tokens(word, value, agent, token, _INSERTIONS, turn + place)
        for place, (word, value) in enumerate(said)
    ]
    last = matrix.presence.shape[1] - 1
    after = matrix.presence[agent, np.minimum(token + 1, last)]
    gone = (token < last) & (after == Presence.ABSENT)
    parts.append(
        _make_tokens(TokenType.REMOVE, zero, agent, token, _INSERTIONS, turn + len(said))
    )
    parts[-1] = TokenSequence(*(column[gone] for column in parts[-1]))
    return parts


def _begin_motion_tokens(num_tokens: int) -> TokenSequence:
    token = np.arange(num_tokens)
    zero = np.zeros_like(token)
    return _make_tokens(TokenType.BEGIN_MOTION, zero, zero + _NO_AGENT, token, _END, zero)


def _make_tokens(
    word: np.ndarray | TokenType,
    value: np.ndarray,
    agent: np.ndarray,
    token: np.ndarray,
    phase: int,
    rank: np.ndarray,
) -> TokenSequence:
    return TokenSequence(
        word=np.full(len(agent), word, dtype=np.uint8),
        value=value.astype(np.int16),
        agent=agent.astype(np.int16),
        token=token.astype(np.uint16),
        phase=np.full(len(agent), phase, dtype=np.uint8),
        rank=rank,
    )
