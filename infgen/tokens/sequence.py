"""The interleaved stream: one scene as one sequence of words, and back.

Each half second says (SPEC 3.4): ``MOVE`` of every observed agent that was there before,
from near to far of the ego; ``STAY`` or ``LEAVE`` of every agent that was there before, in
the same order; for each newcomer ``ADD, CELL, HEADING, KIND``; then ``BEGIN_MOTION``. Near
and far are measured where agents were at the end of the half second before, so the order
tells nothing of what is to come. A newcomer gone with its first half second has a ``LEAVE``
right after its ``KIND``.
"""

from typing import NamedTuple

import numpy as np

from infgen.tokens.agents import AgentMatrix, Anchors, replay
from infgen.tokens.grid import make_grid
from infgen.tokens.insertion import Entries
from infgen.tokens.scene_tokens import FIRST_MOVE, NO_MOVE, Presence, SceneTokens, Word
from infgen.tokens.settings import TokenSettings
from infgen.tokens.vocabulary import MotionVocabulary

_NOBODY = -1
_MOVES, _CONTROLS, _ENTRIES, _END = range(4)


class Words(NamedTuple):
    """Words of the stream, in any order until sorted by ``token``, ``phase``, ``rank``."""

    word: np.ndarray
    value: np.ndarray
    agent: np.ndarray
    token: np.ndarray
    phase: np.ndarray
    rank: np.ndarray


def write_words(matrix: AgentMatrix, entries: Entries, ego: int) -> Words:
    """Write the agent matrix as the interleaved stream."""
    parts = [
        *_write_current(matrix, ego),
        *_write_entries(matrix, entries),
        _write_ends(matrix.move.shape[1]),
    ]
    words = Words(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    order = np.lexsort((words.rank, words.phase, words.token))
    return Words(*(column[order] for column in words))


def decode_sequence(
    tokens: SceneTokens, codebook: MotionVocabulary, settings: TokenSettings
) -> AgentMatrix:
    """Read the agent matrix back from the stream. Inverse of ``write_words``.

    Nothing of ``tokens`` is read but the stream (``word...``), the ego's row, and what
    stands beside the stream: entry offsets and residuals, and the anchors.
    """
    word, token, agent = tokens.word, tokens.word_token, tokens.word_agent
    value, added = tokens.word_value, word == Word.ADD
    shape = int(added.sum()), int((word == Word.BEGIN_MOTION).sum())

    presence = np.full(shape, Presence.ABSENT, dtype=np.int8)
    for said, meant in (
        (Word.STAY, Presence.PRESENT),
        (Word.LEAVE, Presence.LEAVING),
        (Word.ADD, Presence.ENTERING),
    ):
        rows = word == said
        presence[agent[rows], token[rows]] = meant
    move = np.full(shape, NO_MOVE, dtype=np.int16)
    rows = word == Word.MOVE
    move[agent[rows], token[rows]] = value[rows]
    move[agent[added], token[added]] = FIRST_MOVE
    kind = np.zeros(shape[0], dtype=np.int8)
    rows = word == Word.KIND
    kind[agent[rows]] = value[rows]

    entries = Entries(
        token=token[added].astype(np.int16),
        agent=agent[added],
        cell=value[word == Word.CELL],
        offset_m=tokens.entry_offset_m,
        heading=value[word == Word.HEADING],
        residual_rad=tokens.entry_residual_rad,
    )
    anchors = Anchors(tokens.anchor_agent, tokens.anchor_token, tokens.anchor_pose)
    grid = make_grid(settings)
    return replay(kind, move, presence, entries, anchors, tokens.ego, codebook, grid)


def _write_current(matrix: AgentMatrix, ego: int) -> list[Words]:
    """Write moves and controls of the agents that were there before."""
    away_m = matrix.pose[:, :-1, :2] - matrix.pose[ego, :-1, :2]
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])  # [agent, token - 1]
    order = np.argsort(distance_m, axis=0, kind="stable")
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(len(rank))[:, None], axis=0)

    presence, move = matrix.presence[:, 1:], matrix.move[:, 1:]
    agent, token = np.nonzero(move >= 0)
    moves = _words(
        Word.MOVE, move[agent, token], agent, token + 1, _MOVES, rank[agent, token]
    )
    here = (presence == Presence.PRESENT) | (presence == Presence.LEAVING)
    agent, token = np.nonzero(here)
    said = np.where(presence[agent, token] == Presence.LEAVING, Word.LEAVE, Word.STAY)
    controls = _words(
        said, np.zeros_like(agent), agent, token + 1, _CONTROLS, rank[agent, token]
    )
    return [moves, controls]


def _write_entries(matrix: AgentMatrix, entries: Entries) -> list[Words]:
    """Write what is said of each newcomer, all together and in the entries' order."""
    agent, token = entries.agent.astype(np.int64), entries.token.astype(np.int64)
    turn = 5 * np.arange(len(agent))
    zero = np.zeros_like(agent)
    said = [
        (Word.ADD, zero),
        (Word.CELL, entries.cell),
        (Word.HEADING, entries.heading),
        (Word.KIND, matrix.kind[agent]),
    ]
    parts = [
        _words(word, value, agent, token, _ENTRIES, turn + place)
        for place, (word, value) in enumerate(said)
    ]
    last = matrix.presence.shape[1] - 1
    after = matrix.presence[agent, np.minimum(token + 1, last)]
    gone = (token < last) & (after == Presence.ABSENT)
    parts.append(_words(Word.LEAVE, zero, agent, token, _ENTRIES, turn + len(said)))
    parts[-1] = Words(*(column[gone] for column in parts[-1]))
    return parts


def _write_ends(num_tokens: int) -> Words:
    token = np.arange(num_tokens)
    zero = np.zeros_like(token)
    return _words(Word.BEGIN_MOTION, zero, zero + _NOBODY, token, _END, zero)


def _words(
    word: np.ndarray | Word,
    value: np.ndarray,
    agent: np.ndarray,
    token: np.ndarray,
    phase: int,
    rank: np.ndarray,
) -> Words:
    return Words(
        word=np.full(len(agent), word, dtype=np.uint8),
        value=value.astype(np.int16),
        agent=agent.astype(np.int16),
        token=token.astype(np.uint16),
        phase=np.full(len(agent), phase, dtype=np.uint8),
        rank=rank,
    )
