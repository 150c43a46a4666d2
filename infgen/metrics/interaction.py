"""Boxes among boxes: distance to the nearest, collision, time to collision.

Definitions of the official metric (arXiv:2305.12032): boxes have rounded corners, heights
do not matter, and the yaw difference of two boxes is not wrapped. Of all pairs only those
that can matter are measured; bounds on the distance by inscribed and enclosing circles
decide which, so the result is that of measuring all.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.metrics.kinematics import speed
from infgen.metrics.motion import Motion

ROUNDING = np.float32(0.7)
"""Radius of a box's corners over half its shorter side."""
NO_OBJECT_M = np.float32(1e10)
"""Distance where there is nothing, or the box itself is not there."""
MAX_TTC_S = np.float32(5.0)
FOLLOW_YAW_RAD = np.float32(np.radians(75.0))
FOLLOW_ALIGNED_YAW_RAD = np.float32(np.radians(10.0))
FOLLOW_OVERLAP_M = np.float32(-0.5)
SLACK_M = np.float32(0.05)
"""By which bounds are widened, so that float32 rounding cannot prune the nearest."""
PAIRS_PER_BLOCK = 1 << 18


def nearest_object_m(
    motion: Motion, evaluated: Int64[np.ndarray, " object"], steps: slice
) -> Float32[np.ndarray, "rollout object step"]:
    """Distance from each evaluated box to the nearest other, negative when they overlap.

    ``NO_OBJECT_M`` where the box is not valid or alone.
    """
    x_m, y_m, heading_rad, valid = _at(motion, steps)
    found_m = np.full((len(x_m), len(evaluated), x_m.shape[2]), NO_OBJECT_M)
    rounding_m, core_lw_m = _round_corners(motion.size_lwh_m)
    inner_m = motion.size_lwh_m[:, :2].min(axis=1) / 2
    outer_m = np.hypot(core_lw_m[:, 0], core_lw_m[:, 1]) / 2 + rounding_m
    for rollout, some in _blocks(found_m.shape, motion.num_agents):
        rows = evaluated[some]
        gap_m = np.hypot(
            x_m[rollout, rows, None] - x_m[rollout, None],
            y_m[rollout, rows, None] - y_m[rollout, None],
        )  # [object, agent, step]
        there = valid[rollout, rows, None] & valid[rollout, None]
        there[np.arange(len(rows)), rows] = False
        gap_m[~there] = np.inf
        at_most_m = (gap_m - inner_m[:, None]).min(axis=1) - inner_m[rows, None]
        reach_m = at_most_m[:, None] + (outer_m[rows, None] + outer_m)[..., None]
        one, other, step = np.nonzero((gap_m <= reach_m + SLACK_M) & there)
        a, b = rows[one], other
        corners = [
            _corners_m(x_m, y_m, heading_rad, core_lw_m, rollout, agent, step)
            for agent in (a, b)
        ]
        distance_m = quad_distance_m(*corners) - rounding_m[a] - rounding_m[b]
        best_m = np.full((len(rows), found_m.shape[2]), NO_OBJECT_M)
        np.minimum.at(best_m, (one, step), distance_m)
        found_m[rollout, some] = best_m
    return found_m


def quad_distance_m(
    a_m: Float32[np.ndarray, "2 4 pair"], b_m: Float32[np.ndarray, "2 4 pair"]
) -> Float32[np.ndarray, " pair"]:
    """Signed distance between convex quadrilaterals (corners counter-clockwise).

    Apart, some corner of one is nearest to some side of the other. Overlapping, it is
    minus the way to part them: across the side that separates them best.
    """
    apart_a_m, between_a_m = _from_sides(a_m, b_m)
    apart_b_m, between_b_m = _from_sides(b_m, a_m)
    apart_m = np.maximum(apart_a_m, apart_b_m)
    return np.where(apart_m > 0, np.minimum(between_a_m, between_b_m), apart_m)


def _from_sides(own_m: np.ndarray, other_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far all of ``other`` is beyond a side of ``own``, and its corners from the sides.

    Beyond the best side [pair], negative if none separates; and the nearest corner [pair].
    """
    beyond_m = np.full(own_m.shape[2], -np.inf, dtype=np.float32)
    nearest_m2 = np.full(own_m.shape[2], np.inf, dtype=np.float32)
    for side in range(4):
        x, y = own_m[:, side]
        along_x, along_y = own_m[:, (side + 1) % 4] - own_m[:, side]
        length_m2 = along_x * along_x + along_y * along_y
        length_m2 = np.where(length_m2 > 0, length_m2, np.float32(1))
        x, y = other_m[0] - x, other_m[1] - y  # [corner, pair]
        outward = (along_y * x - along_x * y).min(axis=0) / np.sqrt(length_m2)
        beyond_m = np.maximum(beyond_m, outward)
        share = np.clip((x * along_x + y * along_y) / length_m2, 0, 1)
        gap_m2 = (x - share * along_x) ** 2 + (y - share * along_y) ** 2
        nearest_m2 = np.minimum(nearest_m2, gap_m2.min(axis=0))
    return beyond_m, np.sqrt(nearest_m2)


def time_to_collision_s(
    motion: Motion, evaluated: Int64[np.ndarray, " object"], steps: slice
) -> Float32[np.ndarray, "rollout object step"]:
    """Time until each evaluated box meets the one it follows, if both keep their speed.

    At most ``MAX_TTC_S``, also where nothing is followed, it gets away, or a speed is NaN.
    Speeds are of the whole track, so steps before and after ``steps`` take part.
    """
    x_m, y_m, heading_rad, valid = _at(motion, steps)
    speed_mps = speed(motion.x_m, motion.y_m)[:, :, steps]
    found_s = np.full((len(x_m), len(evaluated), x_m.shape[2]), MAX_TTC_S)
    for rollout, some in _blocks(found_s.shape, motion.num_agents):
        rows = evaluated[some]
        one, other, step, gap_m = _followed(
            x_m[rollout], y_m[rollout], heading_rad[rollout], valid[rollout], rows,
            motion.size_lwh_m,
        )  # fmt: skip
        order = np.lexsort((other, gap_m, step, one))
        one, other, step, gap_m = one[order], other[order], step[order], gap_m[order]
        lead = np.ones(len(one), dtype=bool)
        lead[1:] = (one[1:] != one[:-1]) | (step[1:] != step[:-1])
        one, other, step, gap_m = one[lead], other[lead], step[lead], gap_m[lead]
        closing_mps = speed_mps[rollout, rows[one], step] - speed_mps[rollout, other, step]
        closes = closing_mps > 0
        time_s = np.minimum(gap_m[closes] / closing_mps[closes], MAX_TTC_S)
        block_s = np.full((len(rows), found_s.shape[2]), MAX_TTC_S)
        block_s[one[closes], step[closes]] = time_s
        found_s[rollout, some] = block_s
    return found_s


def _followed(
    x_m: Float32[np.ndarray, "agent step"],
    y_m: Float32[np.ndarray, "agent step"],
    heading_rad: Float32[np.ndarray, "agent step"],
    valid: Bool[np.ndarray, "agent step"],
    rows: Int64[np.ndarray, " object"],
    size_lwh_m: Float32[np.ndarray, "agent 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """List followers: object, followed agent, step and the gap between the boxes."""
    half_m = size_lwh_m[:, :2] / 2
    reach_m = np.hypot(half_m[:, 0], half_m[:, 1])
    cos, sin = np.cos(-heading_rad[rows]), np.sin(-heading_rad[rows])  # [object, step]
    dx_m, dy_m = x_m - x_m[rows, None], y_m - y_m[rows, None]  # [object, agent, step]
    ahead_m = cos[:, None] * dx_m - sin[:, None] * dy_m
    aside_m = np.abs(sin[:, None] * dx_m + cos[:, None] * dy_m)
    yaw_rad = np.abs(heading_rad - heading_rad[rows, None])
    near = (ahead_m > (half_m[rows, 0] - SLACK_M)[:, None, None]) & valid
    near &= yaw_rad <= FOLLOW_YAW_RAD
    near &= aside_m < (half_m[rows, 1, None] + reach_m + SLACK_M)[..., None]
    one, other, step = np.nonzero(near)
    ahead_m, aside_m, yaw_rad = ahead_m[near], aside_m[near], yaw_rad[near]
    cos, sin = np.abs(np.cos(yaw_rad)), np.abs(np.sin(yaw_rad))
    half_l_m, half_w_m = half_m[other].T
    gap_m = ahead_m - half_m[rows[one], 0] - (half_l_m * cos + half_w_m * sin)
    overlap_m = aside_m - half_m[rows[one], 1] - (half_l_m * sin + half_w_m * cos)
    follows = (gap_m > 0) & (overlap_m < 0)
    follows &= (overlap_m < FOLLOW_OVERLAP_M) | (yaw_rad <= FOLLOW_ALIGNED_YAW_RAD)
    return one[follows], other[follows], step[follows], gap_m[follows]


def _at(motion: Motion, steps: slice) -> tuple[np.ndarray, ...]:
    """Positions, headings and validity [rollout, agent, step] of some steps."""
    every = (motion.x_m, motion.y_m, motion.heading_rad, motion.valid)
    return tuple(np.ascontiguousarray(values[..., steps]) for values in every)


def _blocks(shape: tuple[int, ...], num_agents: int) -> list[tuple[int, slice]]:
    """Cut [rollout, object] into pieces whose pairs fit the processor's cache."""
    rollouts, objects, steps = shape
    size = max(1, PAIRS_PER_BLOCK // max(1, num_agents * steps))
    starts = range(0, objects, size)
    return [(r, slice(start, start + size)) for r in range(rollouts) for start in starts]


def _round_corners(
    size_lwh_m: Float32[np.ndarray, "agent 3"],
) -> tuple[Float32[np.ndarray, " agent"], Float32[np.ndarray, "agent 2"]]:
    """Radius of the rounded corners, and the sharp box that is left inside them."""
    rounding_m = ROUNDING * size_lwh_m[:, :2].min(axis=1) / 2
    return rounding_m, size_lwh_m[:, :2] - 2 * rounding_m[:, None]


def _corners_m(
    x_m: np.ndarray,
    y_m: np.ndarray,
    heading_rad: np.ndarray,
    size_lw_m: np.ndarray,
    rollout: int,
    agent: np.ndarray,
    step: np.ndarray,
) -> Float32[np.ndarray, "2 4 pair"]:
    """Corners, counter-clockwise from front left, rounded in world frame as officially."""
    ahead_m = size_lw_m[agent, 0] / 2 * np.array([[1], [-1], [-1], [1]], dtype=np.float32)
    aside_m = size_lw_m[agent, 1] / 2 * np.array([[1], [1], [-1], [-1]], dtype=np.float32)
    angle_rad = heading_rad[rollout, agent, step]
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack(
        [
            cos * ahead_m - sin * aside_m + x_m[rollout, agent, step],
            sin * ahead_m + cos * aside_m + y_m[rollout, agent, step],
        ]
    )
