"""Perturbation of tokens to learn from, and motion tokens that lead back (SPEC 2.3, 1.3).

Who only ever sees logs never sees what its own small errors lead to. So agents are led off
their ways a little: at each token step an agent takes not the motion token that ends
nearest to where it should be, but one of the few nearest, and goes on from where that
leads. What is to be learned is always the nearest, from where the agent has come to. As
every draw is near
to the true pose, errors never add up: agents stray as far as a few neighbouring motion
tokens are apart. Who stands is left alone: it would learn to tremble, and that nobody who
has begun to move goes on.

Small errors that last do add up: who turns into a road a few degrees off is metres beside
it two seconds later. So some drivers drift: for seconds they are led beside their ways,
facing where that leads them, and learn how to get back.

Where an agent should be is its quantised pose, which is all that tokens keep of the log. It
is within centimetres of the log's own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int16, Int64

from infgen.model.batching.recovery import WHOLE_RECOVERY, Recovery
from infgen.model.training_settings import TrainSettings
from infgen.tokens.motion_tokens import (
    MatchTable,
    advance,
    make_match_table,
    nearest_motion_tokens,
    ranked_motion_tokens,
)
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

FARTHEST_M = 1.0
"""No draw leads farther from where an agent should be: where motion tokens are rare, the
second nearest may end metres away ..."""
FARTHEST_SHARE = 1 / 8
"""... nor farther than this share of the agent's way in the token step."""

DRIFT_KEPT = 0.8
"""Share of how far aside a drifting agent is that is left one token step later."""
DRIFT_M, DRIFT_SHARE = 0.9, 0.15
"""Typically it is so far aside, or less: this share of its way in one token step ..."""
DRIFT_MOST = 2.0
"""... and never more than so many times as far."""
DRIFT_LEAST_WAY_M = 0.75
"""Agents that go less do not drift."""


@dataclass(frozen=True, eq=False, slots=True)
class Perturbation:
    """How tokens are disturbed.

    Attributes:
        table: The motion tokens.
        moves: How many moves each is drawn from, all equally likely; 0 for none disturbed.
        share: Of the motion tokens that are drawn; the others are the nearest.
        drift: Share of the agents that drift while they are on the motion token.
        near_map_tokens: For each map shape those that it is drawn from, itself the first.
        recovery: How much of a deviation is made good in a token step.
    """

    table: MatchTable
    moves: int
    share: float
    drift: float
    near_map_tokens: Int16[np.ndarray, "road near"]
    recovery: Recovery = WHOLE_RECOVERY


class PerturbedMotion(NamedTuple):
    """Agents off their ways: fields [agent, token] as in ``SceneTokens``.

    Attributes:
        motion_token: The motion tokens taken ...
        pose: ... where they lead ...
        label: ... and the motion tokens that would have led nearest to where agents should
            be.
        off: Where an agent is not where it should be.
    """

    motion_token: np.ndarray
    pose: np.ndarray
    label: np.ndarray
    off: np.ndarray


def make_perturbation(
    settings: TrainSettings, motion: MotionVocabulary, roads: MapVocabulary
) -> Perturbation | None:
    """Make the noise that settings ask for; None if they ask for none.

    In a vocabulary that has fewer tokens, draws are from all of them.
    """
    if not (
        settings.motion_noise_neighbours
        or settings.lateral_drift_share
        or settings.map_noise_neighbours
    ):
        return None
    moves = min(settings.motion_noise_neighbours, motion.num_motion_tokens)
    return Perturbation(
        table=make_match_table(motion),
        moves=max(moves, 1) if settings.lateral_drift_share else moves,
        share=settings.motion_noise_share,
        drift=settings.lateral_drift_share,
        near_map_tokens=_near_map_tokens(roads, max(1, settings.map_noise_neighbours)),
        recovery=Recovery.of(settings),
    )


@dataclass(frozen=True, slots=True)
class LoggedMotion:
    """Agents on their ways, and what is drawn for them.

    Attributes:
        agent_type: ``AgentType``.
        pose: Where each agent should be at each token's end.
        motion_token: What led it there.
        moving: Tokens at which it goes by motion tokens that may be drawn, none of them the
            first. At all others it is where it should be, and starts from there.
        rank: How many motion tokens are nearer to where it should be than the one drawn.
        push: What leads it aside.
    """

    agent_type: Int8[np.ndarray, " agent"]
    pose: Float32[np.ndarray, "agent token 3"]
    motion_token: Int16[np.ndarray, "agent token"]
    moving: Bool[np.ndarray, "agent token"]
    rank: Int64[np.ndarray, "agent token"]
    push: Float64[np.ndarray, "agent token"]

    @classmethod
    def drawn(
        cls,
        agent_type: Int8[np.ndarray, " agent"],
        pose: Float32[np.ndarray, "agent token 3"],
        motion_token: Int16[np.ndarray, "agent token"],
        moving: Bool[np.ndarray, "agent token"],
        noise: Perturbation,
        random: np.random.Generator,
    ) -> "LoggedMotion":
        """Draw what is done to the agents of a scene."""
        rank = random.integers(noise.moves, size=moving.shape)
        rank[random.random(moving.shape) >= noise.share] = 0
        push = _pushes(moving.shape, noise.drift, random)
        return cls(agent_type, pose, motion_token, moving, rank, push)

    @classmethod
    def joined(cls, scenes: "Sequence[LoggedMotion]") -> "LoggedMotion":
        """Put scenes one below the other; the shorter ones stand still in the end."""
        tokens = max(scene.moving.shape[1] for scene in scenes)

        def below(name: str) -> np.ndarray:
            parts = [getattr(scene, name) for scene in scenes]
            more = [(0, 0)] * (parts[0].ndim - 2)
            return np.concatenate(
                [np.pad(x, [(0, 0), (0, tokens - x.shape[1]), *more]) for x in parts]
            )

        agent_type = np.concatenate([scene.agent_type for scene in scenes])
        rest = ("pose", "motion_token", "moving", "rank", "push")
        return cls(agent_type, *(below(name) for name in rest))


def perturb_scenes(
    scenes: Sequence[LoggedMotion], noise: Perturbation
) -> list[PerturbedMotion]:
    """Walk the agents of all scenes anew, together: each call does for hundreds of them."""
    if not scenes:
        return []
    strays, found, first = perturb_motion(LoggedMotion.joined(scenes), noise), [], 0
    for scene in scenes:
        agents, tokens = scene.moving.shape
        part = slice(first, first + agents), slice(0, tokens)
        found.append(PerturbedMotion(*(values[part] for values in strays)))
        first += agents
    return found


def perturb_motion(logged: LoggedMotion, noise: Perturbation) -> PerturbedMotion:
    """Walk agents anew along motion tokens that are drawn."""
    agent_type, pose, motion_token = logged.agent_type, logged.pose, logged.motion_token
    strays = PerturbedMotion(
        motion_token.copy(), pose.copy(), motion_token.copy(), np.zeros_like(logged.moving)
    )
    aside_m = np.zeros(len(agent_type))
    along = replace(noise.recovery, lateral=1.0)  # Drift has its own way back.
    for token in range(1, logged.moving.shape[1]):
        rows = np.flatnonzero(logged.moving[:, token])
        before, wanted = strays.pose[rows, token - 1], pose[rows, token]
        way_m = np.hypot(*(wanted - pose[rows, token - 1])[:, :2].T)
        was_m, aside_m = aside_m, np.zeros(len(agent_type))
        aside_m[rows] = _drifted(was_m[rows], way_m, logged.push[rows, token])
        logged_pose = pose[rows, token - 1]
        ahead = _target(before, logged_pose, wanted, along)
        led = _drift_target(ahead, way_m, was_m[rows], aside_m[rows])

        rank = logged.rank[rows, token]
        nearest, taken = ranked_motion_tokens(
            led, before, agent_type[rows], rank, noise.table
        )
        ends = advance(before, agent_type[rows], taken, noise.table.vocabulary)
        away_m = np.hypot(*(ends - led)[:, :2].T)
        far = np.flatnonzero(away_m > np.minimum(FARTHEST_M, FARTHEST_SHARE * way_m))
        taken[far] = nearest[far]
        ends[far] = advance(
            before[far], agent_type[rows[far]], taken[far], noise.table.vocabulary
        )
        # To those that drift, the nearest is on the drift.
        is_led = aside_m[rows] != 0
        back = np.flatnonzero(
            is_led if noise.recovery.is_whole else is_led | strays.off[rows, token - 1]
        )
        target = _target(before[back], logged_pose[back], wanted[back], noise.recovery)
        nearest[back] = nearest_motion_tokens(
            target, before[back], agent_type[rows[back]], noise.table
        )

        # Agents at their logged poses with logged tokens keep these bit for bit.
        off = strays.off[rows, token - 1] | (taken != motion_token[rows, token])
        strays.label[rows, token], strays.motion_token[rows, token] = nearest, taken
        strays.pose[rows, token] = np.where(off[:, None], ends, wanted)
        strays.off[rows, token] = off
    return strays


def _target(
    pose: Float32[np.ndarray, "row 3"],
    logged: Float32[np.ndarray, "row 3"],
    next_logged: Float32[np.ndarray, "row 3"],
    recovery: Recovery,
) -> Float32[np.ndarray, "row 3"]:
    """Say where agents should be one token step later (``Recovery.target``)."""
    rows = (torch.from_numpy(each) for each in (pose, logged, next_logged))
    return recovery.target(*rows).numpy()


def _pushes(
    shape: tuple[int, ...], drift: float, random: np.random.Generator
) -> Float64[np.ndarray, "agent token"]:
    """Draw what leads agents aside at each token: nothing, for those that do not drift."""
    if not drift:
        return np.zeros(shape)
    drifts = random.random(shape[0]) < drift
    return drifts[:, None] * random.normal(size=shape)


def _drifted(
    aside_m: Float64[np.ndarray, " row"],
    way_m: Float[np.ndarray, " row"],
    push: Float64[np.ndarray, " row"],
) -> Float64[np.ndarray, " row"]:
    """Say how far to the left of their ways agents are led next."""
    spread_m = np.minimum(DRIFT_M, DRIFT_SHARE * way_m) * (way_m >= DRIFT_LEAST_WAY_M)
    fresh_m = math.sqrt(1 - DRIFT_KEPT**2) * spread_m * push
    most_m = DRIFT_MOST * spread_m
    return np.clip(DRIFT_KEPT * aside_m + fresh_m, -most_m, most_m)


def _drift_target(
    wanted: Float32[np.ndarray, "row 3"],
    way_m: Float[np.ndarray, " row"],
    was_m: Float64[np.ndarray, " row"],
    aside_m: Float64[np.ndarray, " row"],
) -> Float32[np.ndarray, "row 3"]:
    """Shift poses to the left, and turn them to where the shift leads."""
    led = wanted.copy()
    led[:, 0] -= aside_m * np.sin(wanted[:, 2])
    led[:, 1] += aside_m * np.cos(wanted[:, 2])
    led[:, 2] += np.where(aside_m, np.arctan2(aside_m - was_m, way_m), 0.0)
    return led


def perturb_map(
    token: Int16[np.ndarray, " road"],
    fixed: Bool[np.ndarray, " road"],
    noise: Perturbation,
    random: np.random.Generator,
) -> Int16[np.ndarray, " road"]:
    """Draw each map token's shape from those near to it, but for the ``fixed``."""
    turn = random.integers(noise.near_map_tokens.shape[1], size=token.shape)
    return np.where(fixed, token, noise.near_map_tokens[token, turn])


def _near_map_tokens(
    vocabulary: MapVocabulary, count: int
) -> Int16[np.ndarray, "road near"]:
    """Return for each shape the nearest, as pieces are matched, itself the first."""
    points_m = vocabulary.sample_m.reshape(vocabulary.num_map_tokens, -1)
    square_m2 = ((points_m[:, None] - points_m) ** 2).sum(axis=-1)
    np.fill_diagonal(square_m2, -1.0)
    return np.argsort(square_m2, axis=1, kind="stable")[:, :count].astype(np.int16)
