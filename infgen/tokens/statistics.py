"""Statistics of tokenized scenes: counts to check a data set by.

TokenStatistics of scenes add up to the figures of a split, so shards count on their own.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Int64

from infgen.clock import CLOCK, Clock
from infgen.scene import AgentType, Scene
from infgen.tokens.presence import first_token, last_token
from infgen.tokens.scene_tokens import NO_CELL, Presence, SceneTokens

ERROR_BIN_M = 0.001
NUM_ERROR_BINS = 1001
"""The last bin holds all errors of a metre and more."""
MAX_COUNTED_INSERTIONS = 32
"""The last bin holds token steps with so many inserted agents and more."""


@dataclass(frozen=True, slots=True)
class TokenStatistics:
    """Sums over scenes. Histograms by token are as long as the longest log.

    Attributes:
        scenes, tokens, roads, words: How many there are.
        agents: Agents of each kind.
        late: Of those, how many enter after the history.
        gaps: Times that a chain of motion tokens starts anew after a gap.
        first: Agents by the token at which they enter.
        last: Agents by their last token.
        entering: Token steps after the history by their inserted agents within the grid.
        beyond: Inserted agents after the history that enter outside the grid.
        error: Observed motion tokens of each kind by how far from the log their end is, in
            bins of ``ERROR_BIN_M``.
    """

    scenes: int
    tokens: int
    roads: int
    words: int
    agents: Int64[np.ndarray, " 3"]
    late: Int64[np.ndarray, " 3"]
    gaps: int
    first: Int64[np.ndarray, " token"]
    last: Int64[np.ndarray, " token"]
    entering: Int64[np.ndarray, " count"]
    beyond: int
    error: Int64[np.ndarray, "3 bin"]

    def __add__(self, other: "TokenStatistics") -> "TokenStatistics":
        sums = {}
        for field in fields(self):
            one, two = getattr(self, field.name), getattr(other, field.name)
            if field.name in ("first", "last"):
                length = max(len(one), len(two))
                one, two = _grown(one, length), _grown(two, length)
            sums[field.name] = one + two
        return TokenStatistics(**sums)


def no_statistics() -> TokenStatistics:
    """Return the statistics of no scene."""
    return TokenStatistics(
        scenes=0,
        tokens=0,
        roads=0,
        words=0,
        agents=np.zeros(3, np.int64),
        late=np.zeros(3, np.int64),
        gaps=0,
        first=np.zeros(0, np.int64),
        last=np.zeros(0, np.int64),
        entering=np.zeros(MAX_COUNTED_INSERTIONS + 1, np.int64),
        beyond=0,
        error=np.zeros((3, NUM_ERROR_BINS), np.int64),
    )


def count(scene: Scene, tokens: SceneTokens, clock: Clock = CLOCK) -> TokenStatistics:
    """Count one scene and its tokens."""
    there = tokens.presence != Presence.ABSENT
    late = tokens.insertion_token > tokens.now
    inside = late & (tokens.insertion_cell != NO_CELL)
    length, after = tokens.num_tokens, tokens.now + 1
    inserted = np.bincount(tokens.insertion_token[inside], minlength=length)[after:]
    return TokenStatistics(
        scenes=1,
        tokens=length,
        roads=tokens.num_map_tokens,
        words=len(tokens.sequence_type),
        agents=np.bincount(tokens.agent_type, minlength=3),
        late=np.bincount(tokens.agent_type[tokens.insertion_agent[late]], minlength=3),
        gaps=len(tokens.anchor_agent) - 1,
        first=np.bincount(first_token(there), minlength=length),
        last=np.bincount(last_token(there), minlength=length),
        entering=np.bincount(
            np.minimum(inserted, MAX_COUNTED_INSERTIONS),
            minlength=MAX_COUNTED_INSERTIONS + 1,
        ),
        beyond=int((late & ~inside).sum()),
        error=_errors(scene, tokens, clock),
    )


def describe(figures: TokenStatistics) -> dict[str, Any]:
    """Return the statistics of a split as JSON values, by agent type where it matters."""
    scenes, agents = max(1, figures.scenes), max(1, int(figures.agents.sum()))
    steps = max(1, int(figures.entering.sum()))
    inserted = int(np.arange(len(figures.entering)) @ figures.entering)
    agent_types = [
        agent_type.name.lower() for agent_type in AgentType if agent_type != AgentType.OTHER
    ]
    return {
        "scenes": figures.scenes,
        "tokens": figures.tokens,
        "agents": dict(zip(agent_types, figures.agents.tolist(), strict=True)),
        "agents_per_scene": figures.agents.sum() / scenes,
        "roads_per_scene": figures.roads / scenes,
        "words_per_scene": figures.words / scenes,
        "gaps": figures.gaps,
        "first_token": figures.first.tolist(),
        "last_token": figures.last.tolist(),
        "share_entering_after_now": figures.late.sum() / agents,
        "entering_after_now": dict(zip(agent_types, figures.late.tolist(), strict=True)),
        "entries_per_token_in_grid": inserted / steps,
        "tokens_by_entries_in_grid": figures.entering.tolist(),
        "entries_beyond_grid": figures.beyond,
        "matching_error_m": {
            agent_type: _spread(counts)
            for agent_type, counts in zip(agent_types, figures.error, strict=True)
        },
    }


def _errors(scene: Scene, tokens: SceneTokens, clock: Clock) -> np.ndarray:
    """Count motion tokens by how far their end is from where the log has the agent."""
    ids = scene.tracks.id
    order = np.argsort(ids, kind="stable")
    row = order[np.searchsorted(ids[order], tokens.track_id)]
    ends = clock.steps_per_token * np.arange(1, tokens.num_tokens + 1)
    logged = tokens.observed & scene.tracks.valid[row[:, None], ends]
    agent, token = np.nonzero(logged)
    away_m = tokens.pose[agent, token, :2] - scene.tracks.xyz_m[row[agent], ends[token], :2]
    bins = (np.hypot(away_m[:, 0], away_m[:, 1]) / ERROR_BIN_M).astype(np.int64)
    flat = tokens.agent_type[agent].astype(np.int64) * NUM_ERROR_BINS + np.minimum(
        bins, NUM_ERROR_BINS - 1
    )
    counts = np.bincount(flat, minlength=len(AgentType) * NUM_ERROR_BINS)
    return counts.reshape(-1, NUM_ERROR_BINS)[:3]


def _grown(counts: np.ndarray, length: int) -> np.ndarray:
    return np.pad(counts, (0, length - len(counts)))


def _spread(counts: np.ndarray) -> dict[str, Any]:
    """Return mean and percentiles of errors from their histogram, to half a bin."""
    total = int(counts.sum())
    if total == 0:
        return {"moves": 0}
    middle_m = (np.arange(len(counts)) + 0.5) * ERROR_BIN_M
    rank = np.cumsum(counts) / total
    p50, p99 = (float(middle_m[np.searchsorted(rank, share)]) for share in (0.5, 0.99))
    return {
        "moves": total,
        "mean": float(counts @ middle_m / total),
        "p50": p50,
        "p99": p99,
        "beyond": int(counts[-1]),
    }
