"""Insertion targets of a cropped scene: the order of insertions, positions and details."""

import numpy as np
from jaxtyping import Float32, Int16, Integer

from infgen.model.batching.crop import SceneWindow
from infgen.model.batching.padding import NO_AGENT, Arrays
from infgen.tokens.grid import Grid, encode_heading, encode_offset, to_grid
from infgen.tokens.scene_tokens import NO_CELL, Presence

OUTSIDE = 1 << 15
"""Turn of an inserted agent that is in no cell: no query may see it yet."""
PSEUDO_PER_TOKEN = 2
"""Pseudo-insertions per token step: present agents that train heading and offset."""


def describe(
    pose: Float32[np.ndarray, "*batch 3"],
    ego_pose: Float32[np.ndarray, "*batch 3"],
    cell: Integer[np.ndarray, "*batch"],
    grid: Grid,
) -> tuple[
    Int16[np.ndarray, "*batch"],
    Float32[np.ndarray, "*batch 2"],
    Int16[np.ndarray, "*batch"],
]:
    """Return heading bins of agents beside egos, offsets within their cells, their bins."""
    heading = encode_heading(pose[..., 2] - ego_pose[..., 2], grid)
    offset_m = to_grid(pose[..., :2], ego_pose) - grid.centre_m[cell]
    return heading, offset_m, encode_offset(offset_m, grid)


def insertion_turns(window: SceneWindow) -> np.ndarray:
    """Turn of every agent among the inserted agents of its token [agent, token]."""
    turn = np.full(window.presence.shape, -1, dtype=np.int64)
    turn[window.presence == Presence.INSERTED] = OUTSIDE
    turn[0] = -1  # The ego is always there to be seen.
    inside = (window.insertion_cell != NO_CELL) & (window.entry_row > 0)
    row, token = window.entry_row[inside], window.insertion_token[inside]
    first = np.searchsorted(token, token)  # Tokens ascend: first inserted agent of each.
    turn[row, token] = np.arange(len(token)) - first
    return turn


def insertion_arrays(window: SceneWindow, turn: np.ndarray, limit: int) -> Arrays:
    """Return the insertions of each token step with a query.

    Not the first: who is there then has not come. Not the last of a log: to have come, one
    must be seen in the token step after it.
    """
    tokens = turn.shape[1]
    inside = (turn >= 0) & (turn < OUTSIDE)
    asked = np.arange(tokens) > 0
    asked[tokens - 1 :] &= window.after > 0
    count = inside.sum(axis=0)
    slots = 1 + min(limit, int(count[1:].max(initial=0)))
    agent = np.full((tokens, slots), NO_AGENT, dtype=np.int64)
    row, token = np.nonzero(inside & (turn < slots) & asked)
    agent[token, turn[row, token]] = row
    cell = np.where(agent >= 0, window.cell[agent, np.arange(tokens)[:, None]], 0)
    add = agent >= 0
    return {"asked": asked, "count": count, "add": add, "agent": agent, "cell": cell}


def detail_arrays(
    window: SceneWindow, entries: Arrays, grid: Grid, random: np.random.Generator
) -> Arrays:
    """Return inserted agents in order, then pseudo-insertions.

    Agents that were led astray would teach places where none is inserted.
    """
    token, turn = np.nonzero(entries["agent"] >= 0)
    row = entries["agent"][token, turn]
    there = (window.presence == Presence.PRESENT) & window.observed
    there &= window.cell != NO_CELL
    there[0], there[:, 0] = False, False
    players = np.argwhere(there)  # [player, (agent, token)]
    # Of all of them, so that noise changes no other draw.
    order = random.permutation(len(players))
    order = order[~window.off[tuple(players[order].T)]]
    few = min(len(order), PSEUDO_PER_TOKEN * (there.shape[1] - 1))
    players = players[np.sort(order[:few])]

    rows = np.concatenate([row, players[:, 0]])
    tokens = np.concatenate([token, players[:, 1]])
    pose, ego_pose = window.pose[rows, tokens], window.pose[0, tokens]
    cell = window.cell[rows, tokens]
    heading, offset_m, offset = describe(pose, ego_pose, cell, grid)
    return {
        "present": np.ones(len(rows), dtype=bool),
        "inserted": np.arange(len(rows)) < len(row),
        "agent": rows,
        "token": tokens,
        "turn": np.concatenate([turn, np.zeros(few, dtype=np.int64)]),
        "cell": cell,
        "agent_type": window.agent_type[rows],
        "size_lwh_m": window.size_lwh_m[rows],
        "heading": heading,
        "offset_m": offset_m,
        "offset": offset,
    }
