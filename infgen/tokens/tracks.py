"""Prepare logged tracks for tokenization: clean, fill gaps, keep the ego's surroundings.

Results hold values at token borders only, steps 0, 5, 10 and so on
(SPEC 1.2, 1.6).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, Int64, UInt8

from infgen.clock import CLOCK, Clock
from infgen.geometry import wrap_angle
from infgen.scene import AgentType, Scene, Tracks
from infgen.tokens.settings import TokenSettings
from infgen.tokens.validity_patterns import encode_patterns

MAX_TURN_RAD = 1.5
"""A heading that turns farther than this in one step is an error of the log."""


class TokensError(ValueError):
    """A scene that cannot be written as tokens."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Every road user of a log at the borders of tokens.

    Attributes:
        track_id: Id of each agent's track.
        agent_type: ``AgentType``; none is ``OTHER``.
        ego: Row of the recording car.
        size_lwh_m: Mean box over the observed steps.
        pose: x, y, heading at each border; meaningless where not valid.
        z_m: Height of the box centre at each border.
        valid: Whether the agent is known there, and near enough to the ego.
        pattern: Which steps of each token the log itself shows
            (``tokens.validity_patterns``), however far from the ego.
        near: Whether it is ever observed within the motion-loss radius of the ego.
        at_now: Whether it is known at the last step of the history.
    """

    track_id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    ego: int
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    pose: Float32[np.ndarray, "agent border 3"]
    z_m: Float32[np.ndarray, "agent border"]
    valid: Bool[np.ndarray, "agent border"]
    pattern: UInt8[np.ndarray, "agent token"]
    near: Bool[np.ndarray, " agent"]
    at_now: Bool[np.ndarray, " agent"]

    def take(self, rows: Int64[np.ndarray, " row"]) -> "Paths":
        """Keep some agents; the ego must be one of them."""
        return Paths(
            track_id=self.track_id[rows],
            agent_type=self.agent_type[rows],
            ego=int(np.flatnonzero(rows == self.ego)[0]),
            size_lwh_m=self.size_lwh_m[rows],
            pose=self.pose[rows],
            z_m=self.z_m[rows],
            valid=self.valid[rows],
            pattern=self.pattern[rows],
            near=self.near[rows],
            at_now=self.at_now[rows],
        )


class _Filled(NamedTuple):
    """Tracks without short gaps."""

    xyz_m: np.ndarray  # [agent, step, 3]
    velocity_mps: np.ndarray  # [agent, step, 2]
    heading_rad: np.ndarray  # [agent, step]
    valid: np.ndarray  # [agent, step]


def read_paths(
    scene: Scene, settings: TokenSettings, until: int | None = None, clock: Clock = CLOCK
) -> Paths:
    """Prepare the tracks of a log for tokenization.

    Args:
        scene: The log.
        settings: How gaps and distance are treated.
        until: Last step to read; None for the whole log.
        clock: Steps and tokens.

    Raises:
        TokensError: if there is no whole token, the history does not end with one, or the
            ego is no road user or not known from the first token to the last.
    """
    last = scene.tracks.num_steps - 1 if until is None else until
    tokens = clock.num_tokens(last + 1)
    _check_time(scene, tokens, last, clock)
    tracks, ego = _road_users(scene, last)
    filled = _fill_gaps(tracks, settings.max_gap_s, ego, clock)

    away_m = filled.xyz_m[..., :2] - filled.xyz_m[ego, :, :2]
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])  # [agent, step]
    known = filled.valid & filled.valid[ego] & (distance_m < settings.max_ego_distance_m)
    if settings.insertion_distance_m > 0:
        arrived = known & (distance_m < settings.insertion_distance_m)
        arrived[:, scene.now] |= known[:, scene.now]
        known &= np.logical_or.accumulate(arrived, axis=1) | known[:, [scene.now]]
    near = (known & (distance_m < settings.motion_loss_distance_m)).any(axis=1)

    pose, valid = _at_borders(filled, known, scene.now, tokens, clock)
    if not valid[ego].all():
        border = int(clock.start_step(int(valid[ego].argmin())))
        raise TokensError(f"the ego is not observed at step {border} of {last}")
    return Paths(
        track_id=tracks.id,
        agent_type=tracks.agent_type,
        ego=ego,
        size_lwh_m=_mean_size(tracks),
        pose=pose,
        z_m=filled.xyz_m[:, :: clock.steps_per_token, 2][:, : tokens + 1],
        valid=valid,
        pattern=encode_patterns(tracks.valid, clock),
        near=near,
        at_now=known[:, scene.now],
    )


def clean_headings(
    heading_rad: Float32[np.ndarray, "agent step"], valid: Bool[np.ndarray, "agent step"]
) -> Float32[np.ndarray, "agent step"]:
    """Replace headings that turn too far in one step by those before them.

    Steps are compared in order with what the step before has become, so a heading that
    flips and stays flipped is turned back throughout (SPEC 1.6).
    """
    turn_rad = np.abs(wrap_angle(np.diff(heading_rad, axis=1)))
    jumps = (turn_rad > MAX_TURN_RAD) & valid[:, 1:] & valid[:, :-1]
    rows = np.flatnonzero(jumps.any(axis=1))
    cleaned = heading_rad.copy()
    if len(rows) == 0:
        return cleaned
    heading, both = cleaned[rows], valid[rows, 1:] & valid[rows, :-1]
    for step in range(int(jumps.any(axis=0).argmax()), both.shape[1]):
        before, after = heading[:, step], heading[:, step + 1]
        jump = both[:, step] & (np.abs(wrap_angle(before - after)) > MAX_TURN_RAD)
        heading[:, step + 1] = np.where(jump, before, after)
    cleaned[rows] = heading
    return cleaned


def _check_time(scene: Scene, tokens: int, last: int, clock: Clock) -> None:
    if tokens < 1:
        raise TokensError(f"{last + 1} steps hold no whole token")
    token = clock.token_ending_at(scene.now)
    if token < 0 or clock.end_step(token) != scene.now or token >= tokens:
        raise TokensError(
            f"the history ends at step {scene.now} of {last}, which no token ends at; "
            f"tokens end at every multiple of {clock.steps_per_token}"
        )


def _road_users(scene: Scene, last: int) -> tuple[Tracks, int]:
    """Take the vehicles, pedestrians and cyclists up to a step, and the ego's new row."""
    tracks = scene.tracks
    rows = np.flatnonzero((tracks.agent_type >= 0) & (tracks.agent_type < AgentType.OTHER))
    ego = np.flatnonzero(rows == scene.ego)
    if len(ego) == 0:
        raise TokensError(
            f"the ego is of kind {tracks.agent_type[scene.ego]}, no road user"
        )
    steps = slice(last + 1)
    users = Tracks(
        id=tracks.id[rows],
        agent_type=tracks.agent_type[rows],
        xyz_m=tracks.xyz_m[rows, steps],
        heading_rad=tracks.heading_rad[rows, steps],
        velocity_mps=tracks.velocity_mps[rows, steps],
        size_lwh_m=tracks.size_lwh_m[rows, steps],
        valid=tracks.valid[rows, steps],
    )
    return users, int(ego[0])


def _fill_gaps(tracks: Tracks, max_gap_s: float, ego: int, clock: Clock) -> _Filled:
    """Interpolate linearly across gaps, and mark short gaps as valid.

    A gap lasts as long as the steps that miss. The ego's gaps are all filled: it is what
    everything else is relative to.
    """
    valid, num_steps = tracks.valid, tracks.num_steps
    steps = np.arange(num_steps)
    before = np.maximum.accumulate(np.where(valid, steps, -1), axis=1)
    after = np.where(valid, steps, num_steps)[:, ::-1]
    after = np.minimum.accumulate(after, axis=1)[:, ::-1]
    row, step = np.nonzero(~valid & (before >= 0) & (after < num_steps))
    before, after = before[row, step], after[row, step]
    share = ((step - before) / (after - before)).astype(np.float32)

    def across(values: np.ndarray) -> np.ndarray:
        change = values[row, after] - values[row, before]
        filled = values.copy()
        filled[row, step] = values[row, before] + share[:, None] * change
        return filled

    heading = clean_headings(tracks.heading_rad, valid)
    turn_rad = wrap_angle(heading[row, after] - heading[row, before])
    heading[row, step] = wrap_angle(heading[row, before] + share * turn_rad)
    short = (after - before - 1) * clock.step_s <= max_gap_s + 1e-6
    known = valid.copy()
    known[row, step] = short | (row == ego)
    return _Filled(across(tracks.xyz_m), across(tracks.velocity_mps), heading, known)


def _at_borders(
    filled: _Filled, known: np.ndarray, now: int, tokens: int, clock: Clock
) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [agent, border, 3] and validity [agent, border] at token borders.

    An agent that appears within a token is taken to have been there from its start, at the
    velocity it appears with. An agent known at ``now`` gets the token that ends there,
    however late in it it appeared: it must be simulated.
    """
    borders = slice(0, clock.steps_per_token * tokens + 1, clock.steps_per_token)
    xy_m, heading = filled.xyz_m[:, borders, :2], filled.heading_rad[:, borders]
    pose = np.concatenate([xy_m, heading[..., None]], axis=-1)
    valid = known[:, borders].copy()

    rows = np.flatnonzero(known.any(axis=1))
    first = known[rows].argmax(axis=1)
    _extend_back(pose, valid, filled, rows, first, first // clock.steps_per_token, clock)

    border = clock.token_ending_at(now)
    rows = np.flatnonzero(known[:, now] & ~valid[:, border])
    unknown = ~known[rows, : now + 1]
    appeared = now + 1 - unknown[:, ::-1].argmax(axis=1)
    _extend_back(pose, valid, filled, rows, appeared, np.full_like(rows, border), clock)
    return pose, valid


def _extend_back(
    pose: np.ndarray,
    valid: np.ndarray,
    filled: _Filled,
    rows: np.ndarray,
    step: np.ndarray,
    border: np.ndarray,
    clock: Clock,
) -> None:
    """Write the borders' poses of agents that are first known at later steps, in place."""
    earlier_s = (step - clock.steps_per_token * border) * np.float32(clock.step_s)
    back_m = filled.velocity_mps[rows, step] * earlier_s.astype(np.float32)[:, None]
    pose[rows, border, :2] = filled.xyz_m[rows, step, :2] - back_m
    pose[rows, border, 2] = filled.heading_rad[rows, step]
    valid[rows, border] = True


def _mean_size(tracks: Tracks) -> Float32[np.ndarray, "agent 3"]:
    """Return the mean box of each agent over the steps at which it was observed."""
    weight = tracks.valid / np.maximum(1, tracks.valid.sum(axis=1))[:, None]
    return np.einsum("as,asc->ac", weight, tracks.size_lwh_m).astype(np.float32)
