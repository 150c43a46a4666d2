"""What the recording car sees of a town's traffic.

Range, walls and tall vehicles limit it; near the limit of its range the tracker flickers.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.geometry import rotate

TALL_M = 2.2
"""Vehicles at least so high hide what is behind them."""
RIM = 0.8
"""Share of the range beyond which tracks flicker."""
FLICKER_STEPS = 3
FLICKER_SHARE = 0.15
SHORTEST_GAP_STEPS = 3
"""The tracker bridges shorter gaps ..."""
SHORTEST_RUN_STEPS = 5
"""... and does not report anything it saw for less."""


@dataclass(frozen=True, slots=True)
class Actors:
    """Everyone and everything with a box, while a scene is recorded.

    Attributes:
        kind: ``AgentKind``.
        size_lwh_m: Boxes.
        pose: Where they are, present or not.
        present: Whether they are there.
    """

    kind: Int64[np.ndarray, " actor"]
    size_lwh_m: Float64[np.ndarray, "actor 3"]
    pose: Float64[np.ndarray, "actor step 3"]
    present: Bool[np.ndarray, "actor step"]


def seen(
    actors: Actors,
    ego: int,
    walls: Float64[np.ndarray, "wall 5"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "actor step"]:
    """Tell which actors the ego's tracker reports at each step; itself always.

    Args:
        actors: All that moves or stands.
        ego: Row of the recording car.
        walls: Boxes that hide: [x, y, heading, length, width].
        rng: Of the sensor's range and flicker.
    """
    reach_m = rng.uniform(60.0, 95.0) * np.array([1.0, 0.75, 0.85])[actors.kind]
    reach_m = reach_m + rng.normal(0.0, 4.0, len(actors.kind))
    eye_m = actors.pose[ego, :, :2]
    apart_m = np.linalg.norm(actors.pose[..., :2] - eye_m, axis=-1)  # [actor, step]
    clear = ~_hidden(actors, ego, eye_m, walls)
    steady = actors.present & clear & (apart_m < reach_m[:, None])
    steady = _opened(_closed(steady, SHORTEST_GAP_STEPS), SHORTEST_RUN_STEPS)
    shown = steady & actors.present & ~_flicker(apart_m, reach_m, rng)
    shown[ego] = actors.present[ego]
    return shown


def _hidden(
    actors: Actors,
    ego: int,
    eye_m: Float64[np.ndarray, "step 2"],
    walls: Float64[np.ndarray, "wall 5"],
) -> Bool[np.ndarray, "actor step"]:
    """Whether middle, front and rear of an actor are all behind something."""
    heading_rad = actors.pose[..., 2]
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    half_m = 0.45 * actors.size_lwh_m[:, 0][:, None, None] * ahead
    middle_m = actors.pose[..., :2]
    hidden = np.ones(actors.present.shape, bool)
    for target_m in (middle_m, middle_m + half_m, middle_m - half_m):
        hidden &= _behind(eye_m, target_m, walls) | _behind_tall(
            actors, ego, eye_m, target_m
        )
    return hidden


def _behind(
    eye_m: Float64[np.ndarray, "step 2"],
    target_m: Float64[np.ndarray, "actor step 2"],
    walls: Float64[np.ndarray, "wall 5"],
) -> Bool[np.ndarray, "actor step"]:
    hidden = np.zeros(target_m.shape[:2], bool)
    for wall in walls:
        pose = np.broadcast_to(wall[:3], (len(eye_m), 3))
        hidden |= _crosses(eye_m, target_m, pose, wall[3:])
    return hidden


def _behind_tall(
    actors: Actors,
    ego: int,
    eye_m: Float64[np.ndarray, "step 2"],
    target_m: Float64[np.ndarray, "actor step 2"],
) -> Bool[np.ndarray, "actor step"]:
    hidden = np.zeros(target_m.shape[:2], bool)
    for tall in np.flatnonzero(actors.size_lwh_m[:, 2] >= TALL_M):
        if tall == ego:
            continue
        size_m = actors.size_lwh_m[tall, :2]
        behind = _crosses(eye_m, target_m, actors.pose[tall], size_m)
        behind[tall] = False
        hidden |= behind & actors.present[tall]
    return hidden


def _crosses(
    eye_m: Float64[np.ndarray, "step 2"],
    target_m: Float64[np.ndarray, "actor step 2"],
    pose: Float64[np.ndarray, "step 3"],
    size_lw_m: Float64[np.ndarray, "2"],
) -> Bool[np.ndarray, "actor step"]:
    """Whether the line of sight meets a box (clipping it by the box's two slabs)."""
    start_m = rotate(eye_m - pose[:, :2], -pose[:, 2])
    way_m = rotate(target_m - eye_m, np.broadcast_to(-pose[:, 2], target_m.shape[:2]))
    way_m = np.where(np.abs(way_m) < 1e-9, 1e-9, way_m)
    one, other = (-size_lw_m / 2 - start_m) / way_m, (size_lw_m / 2 - start_m) / way_m
    enters = np.minimum(one, other).max(axis=-1).clip(0.0)
    leaves = np.maximum(one, other).min(axis=-1).clip(None, 1.0)
    return np.less(enters, leaves)


def _flicker(
    apart_m: Float64[np.ndarray, "actor step"],
    reach_m: Float64[np.ndarray, " actor"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "actor step"]:
    """Draw short losses of track near the limit of the range."""
    num_actors, num_steps = apart_m.shape
    blocks = rng.random((num_actors, -(-num_steps // FLICKER_STEPS))) < FLICKER_SHARE
    lost = np.repeat(blocks, FLICKER_STEPS, axis=1)[:, :num_steps]
    return lost & (apart_m > RIM * reach_m[:, None])


def _opened(
    shown: Bool[np.ndarray, "actor step"], run: int
) -> Bool[np.ndarray, "actor step"]:
    """Drop what is shown for fewer steps in a row."""
    return ~_closed(~shown, run)


def _closed(
    shown: Bool[np.ndarray, "actor step"], gap: int
) -> Bool[np.ndarray, "actor step"]:
    """Fill gaps of fewer steps in a row; the time before and after counts as unknown."""
    shape = (shown.shape[0], gap - 1)
    wide = np.hstack([np.zeros(shape, bool), shown, np.zeros(shape, bool)])
    windows = np.lib.stride_tricks.sliding_window_view(wide, gap, axis=1)
    grown = windows.any(axis=-1)
    both = np.lib.stride_tricks.sliding_window_view(grown, gap, axis=1)
    return np.asarray(both.all(axis=-1))
