"""From points on lanes to bodies: smooth paths, and headings that follow them.

SUMO gives the front of a body and the direction of its lane, which snaps where lanes meet,
and lateral speeds that start and stop at once. Here the front's path is smoothed, and the
rear follows it as a trailer would (a tractrix), so that headings turn no faster than bodies
do.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from infgen.clock import CLOCK
from infgen.sources.towns.traffic.simulation import Played

SMOOTHING_S = 0.35
"""Standard deviation of the weights with which positions are averaged over time."""
WALKER_SMOOTHING_S = 0.8
"""Of walkers: SUMO lets them leap aside where pavements and crossings meet."""
LONGEST_LEAP_M = 2.5
"""Who leaps farther than this in one step is not there any more."""
AXLE = 0.8
"""From the front to the rear axle, as a share of a body's length."""
WALKER_AXLE_M = 0.4
"""Walkers turn as if they trailed a point so far behind."""
_REACH = 3.0
_LEAST_M = 1e-4
"""A front that moves less in a step does not turn its body."""


@dataclass(frozen=True, slots=True)
class Bodies:
    """Boxes of everyone at every step.

    Attributes:
        pose: Middle and heading; where not present, of the nearest moment they were.
        velocity_mps: Of the middle.
        present: Whether they are there.
    """

    pose: Float64[np.ndarray, "trip step 3"]
    velocity_mps: Float64[np.ndarray, "trip step 2"]
    present: Bool[np.ndarray, "trip step"]


def follow(
    played: Played,
    length_m: Float64[np.ndarray, " trip"],
    walks: Bool[np.ndarray, " trip"],
) -> Bodies:
    """Make bodies of the points that SUMO plays.

    Args:
        played: What SUMO gave.
        length_m: Length of each body.
        walks: Who is on foot: SUMO gives the middle of their body, not its front.
    """
    played = replace(played, present=_until_leap(played))
    path_m = _extended(played)
    path_m[walks] = _smoothed(path_m[walks], WALKER_SMOOTHING_S)
    path_m[~walks] = _smoothed(path_m[~walks], SMOOTHING_S)
    axle_m = np.where(walks, WALKER_AXLE_M, AXLE * length_m)
    heading_rad = _trail(path_m, played, axle_m)
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    back_m = np.where(walks, 0.0, length_m / 2)[:, None, None]
    centre_m = path_m - back_m * ahead
    return Bodies(
        pose=np.concatenate([centre_m, heading_rad[..., None]], axis=-1),
        velocity_mps=np.gradient(centre_m, CLOCK.step_s, axis=1),
        present=played.present,
    )


def _ends(present: Bool[np.ndarray, "trip step"]) -> tuple[np.ndarray, np.ndarray]:
    """First and last step at which each is there."""
    first = present.argmax(axis=1)
    last = present.shape[1] - 1 - present[:, ::-1].argmax(axis=1)
    return first, last


def _until_leap(played: Played) -> Bool[np.ndarray, "trip step"]:
    """Who is there and has not leapt yet."""
    there = played.present[:, 1:] & played.present[:, :-1]
    moved_m = np.linalg.norm(np.diff(played.front_m, axis=1), axis=-1)
    leapt = there & (moved_m > LONGEST_LEAP_M + played.speed_mps[:, 1:] * CLOCK.step_s)
    gone = np.maximum.accumulate(leapt, axis=1)
    return played.present & ~np.pad(gone, ((0, 0), (1, 0)))


def _extended(played: Played) -> Float64[np.ndarray, "trip step 2"]:
    """Let those who are not there any more, or not yet, go on straight ahead."""
    rows = np.arange(len(played.present))
    steps = np.arange(played.present.shape[1])
    first, last = _ends(played.present)
    path_m = played.front_m.copy()
    for end, beyond in (
        (first, steps < first[:, None]),
        (last, steps > last[:, None]),
    ):
        heading_rad = played.heading_rad[rows, end]
        ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
        speed_mps = played.speed_mps[rows, end][:, None] * ahead
        away_s = (steps - end[:, None])[..., None] * CLOCK.step_s
        straight_m = played.front_m[rows, end][:, None] + away_s * speed_mps[:, None]
        path_m = np.where(beyond[..., None], straight_m, path_m)
    return path_m


def _smoothed(
    path_m: Float64[np.ndarray, "trip step 2"], spread_s: float
) -> Float64[np.ndarray, "trip step 2"]:
    """Average positions over time with the weights of a bell."""
    reach = round(_REACH * spread_s / CLOCK.step_s)
    away_s = np.arange(-reach, reach + 1) * CLOCK.step_s
    weight = np.exp(-0.5 * (away_s / spread_s) ** 2)
    weight /= weight.sum()
    num_steps = path_m.shape[1]
    # Beyond both ends the path goes on as it begins and ends.
    before_m = path_m[:, :1] + np.arange(-reach, 0)[:, None] * (
        path_m[:, 1:2] - path_m[:, :1]
    )
    after_m = path_m[:, -1:] + np.arange(1, reach + 1)[:, None] * (
        path_m[:, -1:] - path_m[:, -2:-1]
    )
    wide_m = np.concatenate([before_m, path_m, after_m], axis=1)
    mean_m = np.zeros_like(path_m)
    for at, share in enumerate(weight.tolist()):
        mean_m += share * wide_m[:, at : at + num_steps]
    return mean_m


def _trail(
    path_m: Float64[np.ndarray, "trip step 2"],
    played: Played,
    axle_m: Float64[np.ndarray, " trip"],
) -> Float64[np.ndarray, "trip step"]:
    """Headings of bodies whose rear axle is drawn along behind their front."""
    rows = np.arange(len(path_m))
    first, _ = _ends(played.present)
    heading_rad = played.heading_rad[rows, first]
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    found = np.empty(path_m.shape)
    for step in range(path_m.shape[1]):
        before_m = path_m[:, max(step - 1, 0)]
        rear_m = before_m - axle_m[:, None] * ahead
        drawn_m = path_m[:, step] - rear_m
        moved_m = np.linalg.norm(path_m[:, step] - before_m, axis=1)
        turns = (moved_m > _LEAST_M) & (step > first)
        length_m = np.linalg.norm(drawn_m, axis=1, keepdims=True)
        ahead = np.where(turns[:, None], drawn_m / length_m, ahead)
        found[:, step] = ahead
    return np.unwrap(np.arctan2(found[..., 1], found[..., 0]), axis=1)
