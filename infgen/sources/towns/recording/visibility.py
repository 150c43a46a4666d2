"""What the recording car sees: who is in reach and in sight, and where its tracker fails.

Walls hide, and so do tall vehicles; a hidden agent is one whose middle, front and rear are
all behind something. The tracker takes a moment to report and to give up, and loses agents
for a step or more now and then, the more the farther away they are. Whom it loses for long
it takes for somebody new when it finds them again. The figures are those of real logs.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from infgen.clock import CLOCK
from infgen.geometry import box_corners, wrap_angle

LONGEST_REACH_M = 95.0
TALL_M = 1.85
"""Vehicles at least so high hide what is behind them."""
LOOK_STEPS = 2
"""Lines of sight are drawn at every second step."""
SHORTEST_GAP_STEPS = 11
"""The tracker bridges shorter gaps in sight ..."""
SHORTEST_RUN_STEPS = 3
"""... and does not report anything it saw for less."""
LOSS_PER_M = 0.00024
"""Chance to lose an agent in a step, for every metre of distance."""
LOSS_END = 0.55
"""Chance to find it again in a step."""
LONGEST_LOSS_STEPS = 10
"""Who is lost for longer gets another track."""
_REACH_SHARE = np.array([1.0, 0.75, 0.85])
"""How far each kind is seen, as a share of the reach to vehicles."""
_SPREAD_M, _SWING_M, _SWING_S = 5.0, 4.0, 1.5
"""Spread of the reach among agents; how far and how fast that of one agent varies."""


@dataclass(frozen=True, slots=True)
class Actors:
    """Everyone and everything with a box, while a scene is recorded.

    Attributes:
        kind: ``AgentType``.
        size_lwh_m: Boxes.
        pose: Where they are, present or not.
        present: Whether they are there.
    """

    kind: Int64[np.ndarray, " actor"]
    size_lwh_m: Float64[np.ndarray, "actor 3"]
    pose: Float64[np.ndarray, "actor step 3"]
    present: Bool[np.ndarray, "actor step"]


def seen(
    actors: Actors, ego: int, walls: Float64[np.ndarray, "wall 6"], rng: np.random.Generator
) -> Bool[np.ndarray, "actor step"]:
    """Tell which actors the ego's tracker reports at each step; itself always."""
    eye_m = actors.pose[ego, :, :2]
    apart_m = np.linalg.norm(actors.pose[..., :2] - eye_m, axis=-1)  # [actor, step]
    near = actors.present & (apart_m < _reach(actors, rng))
    steady = near & ~_hidden(actors, ego, walls, near.any(axis=1))
    steady = _opened(_closed(steady, SHORTEST_GAP_STEPS), SHORTEST_RUN_STEPS)
    shown = steady & actors.present & ~_losses(apart_m, rng)
    shown[ego] = actors.present[ego]
    return shown


def tracks_of(
    shown: Bool[np.ndarray, "actor step"],
) -> tuple[Int64[np.ndarray, " track"], Bool[np.ndarray, "track step"]]:
    """Cut what is shown of each actor into tracks, where it is lost for too long.

    Returns:
        The actor of each track, and when the track shows it.
    """
    steps = np.arange(shown.shape[1])
    last = np.maximum.accumulate(np.where(shown, steps, -1), axis=1)
    before = np.pad(last[:, :-1], ((0, 0), (1, 0)), constant_values=-1)
    anew = shown & (before >= 0) & (steps - before > LONGEST_LOSS_STEPS + 1)
    part = np.cumsum(anew, axis=1)
    actor, tracks = [np.zeros(0, np.int64)], [np.zeros((0, len(steps)), bool)]
    for at in range(int(part.max(initial=0)) + 1):
        of_part = shown & (part == at)
        rows = np.flatnonzero(of_part.any(axis=1))
        actor.append(rows)
        tracks.append(of_part[rows])
    return np.concatenate(actor), np.concatenate(tracks)


def wander(
    num_rows: int, num_steps: int, time_s: float, rng: np.random.Generator
) -> Float64[np.ndarray, "row step"]:
    """Draw noise of unit spread that forgets itself within a time (AR(1))."""
    kept = np.exp(-CLOCK.step_s / time_s)
    noise = rng.normal(size=(num_rows, num_steps))
    noise[:, 1:] *= np.sqrt(1 - kept**2)
    for step in range(1, num_steps):
        noise[:, step] += kept * noise[:, step - 1]
    return noise


def _reach(actors: Actors, rng: np.random.Generator) -> Float64[np.ndarray, "actor step"]:
    """How far each actor is seen at each step."""
    count, steps = actors.present.shape
    reach_m = rng.uniform(66.0, 80.0) * _REACH_SHARE[actors.kind]
    reach_m = reach_m + rng.normal(0.0, _SPREAD_M, count)
    varied_m = reach_m[:, None] + _SWING_M * wander(count, steps, _SWING_S, rng)
    return np.minimum(varied_m, LONGEST_REACH_M)


def _hidden(
    actors: Actors,
    ego: int,
    walls: Float64[np.ndarray, "wall 6"],
    near: Bool[np.ndarray, " actor"],
) -> Bool[np.ndarray, "actor step"]:
    """Whether middle, front and rear are all behind something; of those in reach only."""
    steps = np.arange(actors.present.shape[1])
    looks = steps[::LOOK_STEPS]
    rows = np.flatnonzero(near)
    tall = rows[(actors.size_lwh_m[rows, 2] >= TALL_M) & (rows != ego)]
    standing = np.broadcast_to(walls[:, None, :3], (len(walls), len(looks), 3))
    pose = np.concatenate([standing, actors.pose[tall][:, looks]])
    size_lw_m = np.concatenate([walls[:, 3:5], actors.size_lwh_m[tall, :2]])
    hides = np.ones(pose.shape[:2], bool)
    hides[len(walls) :] = actors.present[tall][:, looks]
    eye_m = actors.pose[ego, looks, :2]
    targets_m = (_targets(actors, rows, looks) - eye_m).astype(np.float32)
    blinds = _silhouettes(pose, size_lw_m, eye_m)
    behind = np.zeros(targets_m.shape[:3], bool)
    itself = np.concatenate([np.full(len(walls), -1), tall])
    for blind_m, hiding, row in zip(blinds, hides, itself.tolist(), strict=True):
        behind |= _covers(blind_m, targets_m) & hiding & (rows != row)[:, None]
    hidden = np.zeros(actors.present.shape, bool)
    hidden[rows] = np.asarray(behind.all(axis=0))[:, steps // LOOK_STEPS]
    return hidden


def _targets(
    actors: Actors, rows: Int64[np.ndarray, " row"], looks: Int64[np.ndarray, " look"]
) -> Float64[np.ndarray, "3 row look 2"]:
    """Middle, front and rear of some actors."""
    pose = actors.pose[rows][:, looks]
    ahead = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
    half_m = 0.45 * actors.size_lwh_m[rows, 0][:, None, None] * ahead
    return np.stack([pose[..., :2], pose[..., :2] + half_m, pose[..., :2] - half_m])


def _silhouettes(
    pose: Float64[np.ndarray, "block look 3"],
    size_lw_m: Float64[np.ndarray, "block 2"],
    eye_m: Float64[np.ndarray, "look 2"],
) -> Float32[np.ndarray, "block look 2 2"]:
    """The corners of boxes that an eye sees farthest right and left, from the eye."""
    size_m = np.broadcast_to(size_lw_m[:, None], (*pose.shape[:2], 2))
    corners_m = box_corners(pose, size_m) - eye_m[:, None]  # [block, look, 4, 2]
    middle_m = pose[..., :2] - eye_m
    middle_rad = np.arctan2(middle_m[..., 1], middle_m[..., 0])[..., None]
    bearing_rad = np.arctan2(corners_m[..., 1], corners_m[..., 0])
    aside_rad = wrap_angle(bearing_rad - middle_rad)
    ends = np.stack([aside_rad.argmin(axis=-1), aside_rad.argmax(axis=-1)], axis=-1)
    return np.take_along_axis(corners_m, ends[..., None], axis=2).astype(np.float32)


def _covers(
    blind_m: Float32[np.ndarray, "look 2 2"], target_m: Float32[np.ndarray, "3 row look 2"]
) -> Bool[np.ndarray, "3 row look"]:
    """Whether targets are behind a silhouette: within its angle, and beyond it."""
    right_m, left_m = blind_m[:, 0], blind_m[:, 1]
    across_m, from_right_m = left_m - right_m, target_m - right_m
    return (
        (_cross(right_m, target_m) > 0)
        & (_cross(target_m, left_m) > 0)
        & (_cross(across_m, from_right_m) < 0)
    )


def _cross(
    one: Float32[np.ndarray, "... 2"], other: Float32[np.ndarray, "... 2"]
) -> Float32[np.ndarray, "..."]:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


def _losses(
    apart_m: Float64[np.ndarray, "actor step"], rng: np.random.Generator
) -> Bool[np.ndarray, "actor step"]:
    """Draw short losses of track."""
    begins = rng.random(apart_m.shape) < LOSS_PER_M * apart_m
    length = np.minimum(rng.geometric(LOSS_END, apart_m.shape), LONGEST_LOSS_STEPS)
    lost = np.zeros(apart_m.shape, bool)
    for since in range(min(LONGEST_LOSS_STEPS, apart_m.shape[1])):
        late = slice(0, apart_m.shape[1] - since)
        lost[:, since:] |= begins[:, late] & (length[:, late] > since)
    return lost


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
    grown = np.lib.stride_tricks.sliding_window_view(wide, gap, axis=1).any(axis=-1)
    both = np.lib.stride_tricks.sliding_window_view(grown, gap, axis=1)
    return np.asarray(both.all(axis=-1))
