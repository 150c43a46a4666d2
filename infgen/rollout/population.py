"""All agents of a batch of rollouts: insertion, motion and removal.

An agent keeps its row while it is present; after its removal the row is free for the next
inserted agent. Row 0 is always the ego. Plain arrays; the network sees them as a
``TokenStep``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int16, Int32, Int64

from infgen.geometry import to_world, wrap_angle
from infgen.rollout.recording import NO_AGENT, RolloutStart
from infgen.tokens.grid import Grid, encode_cell, from_grid, to_grid
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)
from infgen.tokens.vocabulary import MotionVocabulary

EGO_ROW = 0


@dataclass(frozen=True, slots=True)
class Population:
    """All agents of all rollouts of a batch at the end of one token step.

    Attributes:
        agent_number: Number of the agent in its rollout, or ``NO_AGENT`` in a free row.
        num_agents_so_far: Agent numbers given so far in each rollout.
        agent_type: ``AgentType``.
        size_lwh_m: Boxes.
        pose: x, y, heading in the scene's frame.
        motion_token: Motion token of this token step, ``FIRST_MOTION_TOKEN`` where
            inserted, else ``NO_MOTION_TOKEN``.
        presence: ``Presence``; ``ABSENT`` in a free row.
        observed: False where absent, just inserted, or (in the history) not in the log.
    """

    agent_number: Int32[np.ndarray, "rollout row"]
    num_agents_so_far: Int32[np.ndarray, " rollout"]
    agent_type: Int8[np.ndarray, "rollout row"]
    size_lwh_m: Float32[np.ndarray, "rollout row 3"]
    pose: Float32[np.ndarray, "rollout row 3"]
    motion_token: Int16[np.ndarray, "rollout row"]
    presence: Int8[np.ndarray, "rollout row"]
    observed: Bool[np.ndarray, "rollout row"]

    @property
    def num_agents(self) -> Int64[np.ndarray, " rollout"]:
        """Agents of each rollout."""
        return (self.agent_number != NO_AGENT).sum(axis=1)

    @property
    def visible(self) -> Bool[np.ndarray, "rollout row"]:
        """Rows that others see: observed, or just inserted."""
        return self.observed | (self.presence == Presence.INSERTED)

    def cells(self, grid: Grid) -> Int16[np.ndarray, "rollout row"]:
        """Cell [rollout, row] of the ego's grid that holds each agent, or ``NO_CELL``."""
        there = self.presence != Presence.ABSENT
        rollout, _ = np.nonzero(there)
        ego_pose = self.pose[rollout, EGO_ROW]
        cell = np.full(there.shape, NO_CELL, dtype=np.int16)
        cell[there] = encode_cell(to_grid(self.pose[there, :2], ego_pose), grid)
        return cell

    def count_others(self, radius_m: float) -> Int64[np.ndarray, " rollout"]:
        """Count the agents within a radius of each ego, without the ego."""
        near = (_ego_distance_m(self) < radius_m) & (self.presence != Presence.ABSENT)
        near[:, EGO_ROW] = False
        return near.sum(axis=1)

    def without_free_rows(self) -> "Population":
        """Drop the last rows that are free in every rollout."""
        used = (self.agent_number != NO_AGENT).any(axis=0)
        rows = len(used) - int(used[::-1].argmax())
        cut = {f.name: getattr(self, f.name) for f in fields(self)}
        return Population(
            **{
                name: every[:, :rows] if every.ndim > 1 else every
                for name, every in cut.items()
            }
        )

    def with_rows(self, rows: int) -> "Population":
        """Append free rows, up to so many."""
        more = _empty(len(self.agent_number), rows - self.agent_number.shape[1])
        return Population(
            **{
                f.name: np.concatenate([getattr(self, f.name), getattr(more, f.name)], 1)
                if getattr(self, f.name).ndim > 1
                else getattr(self, f.name)
                for f in fields(self)
            }
        )

    def take(self, rollouts: Int64[np.ndarray, " kept"]) -> "Population":
        """Take some rollouts."""
        return _take(self, rollouts)

    def put(
        self, rollouts: Int64[np.ndarray, " replaced"], others: "Population"
    ) -> "Population":
        """Replace some rollouts by others. Inverse of ``take``."""
        return _put(self, rollouts, others)

    def copy(self) -> "Population":
        """Return arrays of its own."""
        return replace(self, **{f.name: getattr(self, f.name).copy() for f in fields(self)})


@dataclass(frozen=True, slots=True)
class InsertedAgents:
    """At most one inserted agent per rollout.

    Attributes:
        who: Rollouts that have one; the values of others are undefined.
        position_m: Position in the grid frame of the ego.
        turned_rad: Heading relative to the ego.
        agent_type: ``AgentType``.
        size_lwh_m: Box.
    """

    who: Bool[np.ndarray, " rollout"]
    position_m: Float32[np.ndarray, "rollout 2"]
    turned_rad: Float32[np.ndarray, " rollout"]
    agent_type: Int8[np.ndarray, " rollout"]
    size_lwh_m: Float32[np.ndarray, "rollout 3"]

    def take(self, rollouts: Int64[np.ndarray, " kept"]) -> "InsertedAgents":
        """Take some rollouts."""
        return _take(self, rollouts)

    def put(
        self, rollouts: Int64[np.ndarray, " kept"], others: "InsertedAgents"
    ) -> "InsertedAgents":
        """Replace those of some rollouts by others. Inverse of ``take``."""
        return _put(self, rollouts, others)


R = TypeVar("R", Population, InsertedAgents)


def _take(record: R, rollouts: np.ndarray) -> R:
    return replace(
        record, **{f.name: getattr(record, f.name)[rollouts] for f in fields(record)}
    )


def _put(record: R, rollouts: np.ndarray, others: R) -> R:
    changed = {f.name: getattr(record, f.name).copy() for f in fields(record)}
    for name, values in changed.items():
        values[rollouts] = getattr(others, name)
    return replace(record, **changed)


def place_logged_agents(starts: Sequence[RolloutStart], min_rows: int) -> list[Population]:
    """Give every agent of the histories a row, the ego first, then near to far.

    Returns:
        The population at every token step of the history. At the last one the poses are
        those of the log, so that a rollout continues the log without a jump.

    Raises:
        ValueError: if the histories end at different tokens.
    """
    now = starts[0].history.now
    if any(start.history.now != now for start in starts):
        raise ValueError("a batch of rollouts must start from histories of one length")
    rows = max(min_rows, *(start.history.num_agents for start in starts))
    return [_place_logged_at(starts, rows, token) for token in range(now + 1)]


def _place_logged_at(starts: Sequence[RolloutStart], rows: int, token: int) -> Population:
    empty = _empty(len(starts), rows)
    for at, start in enumerate(starts):
        history = start.history
        order = _near_to_far(start)
        place = slice(0, len(order))
        empty.agent_number[at, place] = order
        empty.num_agents_so_far[at] = len(order)
        empty.agent_type[at, place] = history.agent_type[order]
        empty.size_lwh_m[at, place] = history.size_lwh_m[order]
        empty.pose[at, place] = history.pose[order, token]
        empty.motion_token[at, place] = history.motion_token[order, token]
        empty.presence[at, place] = history.presence[order, token]
        empty.observed[at, place] = history.observed[order, token]
        if token == history.now:
            logged = start.scene.tracks.pose(start.scene.now)[start.logged_row[order]]
            empty.pose[at, place] = logged
    return empty


def _near_to_far(start: RolloutStart) -> Int64[np.ndarray, " agent"]:
    history = start.history
    xy_m = history.pose[:, history.now, :2]
    distance_m = np.linalg.norm(xy_m - xy_m[history.ego], axis=1)
    distance_m[history.ego] = -1.0
    return np.argsort(distance_m, kind="stable")


def _empty(rollouts: int, rows: int) -> Population:
    shape = (rollouts, rows)
    return Population(
        agent_number=np.full(shape, NO_AGENT, dtype=np.int32),
        num_agents_so_far=np.zeros(rollouts, dtype=np.int32),
        agent_type=np.zeros(shape, dtype=np.int8),
        size_lwh_m=np.zeros((*shape, 3), dtype=np.float32),
        pose=np.zeros((*shape, 3), dtype=np.float32),
        motion_token=np.full(shape, NO_MOTION_TOKEN, dtype=np.int16),
        presence=np.zeros(shape, dtype=np.int8),
        observed=np.zeros(shape, dtype=bool),
    )


def advance_agents(
    population: Population,
    motion_token: Int64[np.ndarray, "rollout row"],
    remove: Bool[np.ndarray, "rollout row"],
    vocabulary: MotionVocabulary,
) -> tuple[Population, Float32[np.ndarray, "rollout row 5 3"]]:
    """Move every agent by one token step; rows of removed agents become free.

    Args:
        population: At the end of a token step.
        motion_token: Next motion token of each row.
        remove: Rows whose agent is present for the last time; never the ego.
        vocabulary: Motion tokens.

    Returns:
        The population at the end of the next token step, and the poses
        [rollout, row, 5, 3] at its five steps.
    """
    gone = population.presence == Presence.REMOVED
    there = (population.presence != Presence.ABSENT) & ~gone
    remove = remove & there
    remove[:, EGO_ROW] = False
    paths = vocabulary.path.reshape(-1, *vocabulary.path.shape[2:])
    row = population.agent_type[there] * np.int64(vocabulary.num_motion_tokens)
    steps = paths.take(row + motion_token[there], axis=0)[:, 1:]
    path = np.zeros((*there.shape, *steps.shape[1:]), dtype=np.float32)
    path[there] = to_world(steps, population.pose[there][:, None])
    presence = np.where(remove, Presence.REMOVED, Presence.PRESENT) * there
    moved = replace(
        population,
        agent_number=np.where(there, population.agent_number, NO_AGENT).astype(np.int32),
        pose=path[:, :, -1],
        motion_token=np.where(there, motion_token, NO_MOTION_TOKEN).astype(np.int16),
        presence=presence.astype(np.int8),
        observed=there,
    )
    return moved, path


def remove_beyond(before: Population, moved: Population, radius_m: float) -> Population:
    """Remove agents that cross a circle around the ego outwards.

    Agents that were outside before stay: the ego may come nearer.

    Args:
        before: One token step earlier.
        moved: Now.
        radius_m: Of the circle.
    """
    leaves = (_ego_distance_m(moved) > radius_m) & (_ego_distance_m(before) <= radius_m)
    leaves &= moved.presence == Presence.PRESENT
    presence = np.where(leaves, np.int8(Presence.REMOVED), moved.presence)
    return replace(moved, presence=presence)


def _ego_distance_m(population: Population) -> Float32[np.ndarray, "rollout row"]:
    away_m = population.pose[..., :2] - population.pose[:, EGO_ROW, None, :2]
    return np.hypot(away_m[..., 0], away_m[..., 1])


def add_inserted(
    population: Population, inserted: InsertedAgents
) -> tuple[Population, Int64[np.ndarray, " rollout"]]:
    """Give each inserted agent the first free row of its rollout.

    Returns:
        The population with them, and the row that each rollout's inserted agent got (-1
        where there is none). A full rollout drops its inserted agent.
    """
    new, who = population.copy(), np.flatnonzero(inserted.who)
    row = np.full(len(inserted.who), -1, dtype=np.int64)
    row[who] = place_inserted(new, who, inserted.take(who))
    return new, row


def place_inserted(
    population: Population,
    rollouts: Int64[np.ndarray, " inserted"],
    inserted: InsertedAgents,
) -> Int64[np.ndarray, " inserted"]:
    """Write inserted agents into a population, which changes in place.

    Args:
        population: All agents.
        rollouts: Where each is inserted: at most one into a rollout.
        inserted: The agents.

    Returns:
        The row that each agent got: the first free one; -1 in a full rollout.
    """
    free = population.agent_number[rollouts] == NO_AGENT
    row, fits = free.argmax(axis=1), free.any(axis=1)
    pose = insertion_pose(population.pose[rollouts, EGO_ROW], inserted)[fits]
    rollout, at = rollouts[fits], (rollouts[fits], row[fits])
    population.agent_number[at] = population.num_agents_so_far[rollout]
    population.num_agents_so_far[rollout] += 1
    population.agent_type[at] = inserted.agent_type[fits]
    population.size_lwh_m[at] = inserted.size_lwh_m[fits]
    population.pose[at] = pose
    population.motion_token[at] = FIRST_MOTION_TOKEN
    population.presence[at] = Presence.INSERTED
    population.observed[at] = False
    return np.where(fits, row, -1)


def insertion_pose(
    ego_pose: Float32[np.ndarray, "rollout 3"], inserted: InsertedAgents
) -> Float32[np.ndarray, "rollout 3"]:
    """Poses [rollout, 3] of inserted agents in the scene's frame."""
    pose = np.empty_like(ego_pose)
    pose[:, :2] = from_grid(inserted.position_m, ego_pose)
    pose[:, 2] = wrap_angle(inserted.turned_rad + ego_pose[:, 2])
    return pose
