"""Entries and exits: their token steps and distances from the ego.

Log and simulation are read the same way. An agent enters in the token step at whose end it
is first placed, and leaves in the last one it is seen through (SPEC 3.3). The ego and
agents present now have not entered.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16, Int64

from infgen.clock import CLOCK
from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from infgen.tokens.presence import has_motion, presence_states, seen_tokens
from infgen.tokens.scene_tokens import Presence
from infgen.tokens.settings import TokenSettings
from infgen.tokens.tracks import read_paths


@dataclass(frozen=True, slots=True)
class Events:
    """Entries and exits after now, in any order.

    Attributes:
        entry_token: Token steps after now (0 is the first) of each entry.
        entry_distance_m: Distance to the ego there; NaN where it is not known.
        exit_token: Token steps after now of each exit.
        exit_distance_m: Distance to the ego there.
    """

    entry_token: Int16[np.ndarray, " entry"]
    entry_distance_m: Float32[np.ndarray, " entry"]
    exit_token: Int16[np.ndarray, " exit"]
    exit_distance_m: Float32[np.ndarray, " exit"]


def logged_events(scene: Scene, settings: TokenSettings) -> Events:
    """List the entries and exits of a log, as the tokenizer sees them.

    Raises:
        TokensError: if the log cannot be written as tokens.
    """
    paths = read_paths(scene, settings)
    seen = seen_tokens(paths.valid)
    rows = np.flatnonzero(has_motion(seen))
    presence = presence_states(seen)
    first = CLOCK.token_ending_at(scene.now) + 1
    away_m = paths.pose[:, 1:, :2] - paths.pose[paths.ego, 1:, :2]  # at tokens' ends
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])
    found = []
    for state in (Presence.INSERTED, Presence.REMOVED):
        agent, token = np.nonzero(presence[rows, first:] == state)
        found += [token.astype(np.int16), distance_m[rows[agent], first + token]]
    return Events(*found)


def simulated_events(rollout: Rollout) -> Events:
    """List the entries and exits of a rollout.

    An inserted agent is placed at a pose that is not one of its valid steps; where it was
    follows from the two steps after it.
    """
    first = rollout.now + 1
    others = np.arange(len(rollout.id)) != rollout.ego
    entered = np.flatnonzero((rollout.entry_step > rollout.now) & others)
    left = np.flatnonzero(
        (rollout.exit_step != NEVER) & (rollout.exit_step > rollout.now) & others
    )
    entry_step = rollout.entry_step[entered].astype(np.int64)
    exit_step = rollout.exit_step[left].astype(np.int64)
    return Events(
        entry_token=_token(entry_step - first),
        entry_distance_m=_entry_distance_m(rollout, entered, entry_step),
        exit_token=_token(exit_step - first),
        exit_distance_m=_distance_m(rollout, rollout.xyz_m[left, exit_step], exit_step),
    )


def count_per_token(
    token: Int16[np.ndarray, " event"],
    distance_m: Float32[np.ndarray, " event"],
    radius_m: float,
    num_tokens: int,
) -> Int64[np.ndarray, " token"]:
    """Count events within a radius of the ego in each token step.

    With an infinite radius, also those whose distance is not known.
    """
    within = np.ones(len(token), bool) if np.isinf(radius_m) else distance_m < radius_m
    within &= token < num_tokens
    return np.bincount(token[within], minlength=num_tokens).astype(np.int64)


def _token(steps_after: np.ndarray) -> Int16[np.ndarray, " event"]:
    return (steps_after // CLOCK.steps_per_token).astype(np.int16)


def _entry_distance_m(
    rollout: Rollout, rows: np.ndarray, step: np.ndarray
) -> Float32[np.ndarray, " entry"]:
    last = rollout.num_steps - 1
    one, two = np.minimum(step + 1, last), np.minimum(step + 2, last)
    placed_m = 2 * rollout.xyz_m[rows, one] - rollout.xyz_m[rows, two]
    known = rollout.valid[rows, one] & rollout.valid[rows, two] & (step + 2 <= last)
    return np.where(known, _distance_m(rollout, placed_m, step), np.float32(np.nan))


def _distance_m(
    rollout: Rollout, xyz_m: np.ndarray, step: np.ndarray
) -> Float32[np.ndarray, " event"]:
    away_m = xyz_m[:, :2] - rollout.xyz_m[rollout.ego, step, :2]
    return np.hypot(away_m[:, 0], away_m[:, 1])
