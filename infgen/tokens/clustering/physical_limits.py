"""Physical limits of motion tokens, and the smoothing of logged noise.

The vocabulary holds no motion token beyond these limits. Speed, acceleration and turn are
bounded at every 0.1 s step; acceleration as a vector. All three bounds are convex, so a
mean of motion within them is within them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from infgen.clock import CLOCK
from infgen.geometry import rotate, wrap_angle
from infgen.scene import AgentType
from infgen.tokens.clustering.settings import VocabSettings

PEDESTRIAN_MAX_YAW_RATE_RAD_S = 2 * np.pi
"""A pedestrian turns round on the spot within one motion token; others obey the setting."""

MAX_REVERSE_MPS = (6.0, 2.0, 1.5)
"""Who goes backwards faster is logged with a wrong heading (row: ``AgentType``)."""

JUMP_FACTOR = 4.0
"""A step that changes velocity by so many times the limit is a jump of the log, not noise
that may be smoothed."""

MAX_SIDE_SLIP_M, MAX_PIVOT_M = 0.3, (3.0, 0.0, 1.0)
"""Wheels turn a body about the rear axle, at most ``MAX_PIVOT_M`` behind its centre,
which swings out; beyond that the centre goes sideways by no more than ``MAX_SIDE_SLIP_M``.
A
pedestrian may step aside."""

_INSIDE, _SMOOTHED = 1 - 1e-3, 1 - 2e-3
"""Moves keep this far inside the limits, so that no rounding brings them outside."""


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Bounds by kind (row: ``AgentType``).

    Attributes:
        speed_mps: No step is faster.
        accel_mps2: No two steps in a row change velocity faster.
        yaw_rate_rad_s: No step turns faster.
    """

    speed_mps: Float32[np.ndarray, "3"]
    accel_mps2: Float32[np.ndarray, "3"]
    yaw_rate_rad_s: Float32[np.ndarray, "3"]


def motion_limits(settings: VocabSettings) -> MotionLimits:
    """Take the limits from the settings."""
    speed_mps = [
        settings.vehicle_max_speed_mps,
        settings.pedestrian_max_speed_mps,
        settings.cyclist_max_speed_mps,
    ]
    yaw = settings.max_yaw_rate_rad_s
    return MotionLimits(
        speed_mps=np.array(speed_mps, dtype=np.float32),
        accel_mps2=np.full(3, settings.max_accel_mps2, dtype=np.float32),
        yaw_rate_rad_s=np.array([yaw, PEDESTRIAN_MAX_YAW_RATE_RAD_S, yaw], np.float32),
    )


def keeps_limits(
    path: Float32[np.ndarray, "motion 6 3"], agent_type: int, limits: MotionLimits
) -> Bool[np.ndarray, " motion"]:
    """Tell which motion tokens keep to the limits of an agent type at every step."""
    speed_mps, accel_mps2, yaw_rad_s = _rates(path)
    return (
        (speed_mps <= limits.speed_mps[agent_type] * _INSIDE)
        & (accel_mps2 <= limits.accel_mps2[agent_type] * _INSIDE)
        & (yaw_rad_s <= limits.yaw_rate_rad_s[agent_type] * _INSIDE)
        & _follows_heading(path, agent_type)
    )


def plausible(
    path: Float32[np.ndarray, "motion 6 3"], agent_type: int, limits: MotionLimits
) -> Bool[np.ndarray, " motion"]:
    """Tell which logged motion is possible once ``smooth`` has removed its jitter."""
    speed_mps, accel_mps2, _ = _rates(path)
    step_m = np.diff(path[..., :2], axis=1)
    change_mps = np.linalg.norm(step_m[:, -1] - step_m[:, 0], axis=-1) / CLOCK.step_s
    mean_accel_mps2 = change_mps / (CLOCK.token_s - CLOCK.step_s)
    mean_yaw_rad_s = np.abs(path[:, -1, 2]) / CLOCK.token_s
    return (
        (speed_mps <= limits.speed_mps[agent_type] * _SMOOTHED)
        & (accel_mps2 <= limits.accel_mps2[agent_type] * JUMP_FACTOR)
        & (mean_accel_mps2 <= limits.accel_mps2[agent_type] * _SMOOTHED)
        & (mean_yaw_rad_s <= limits.yaw_rate_rad_s[agent_type] * _SMOOTHED)
        & _follows_heading(path, agent_type)
    )


def smooth(
    path: Float32[np.ndarray, "motion 6 3"], agent_type: int, limits: MotionLimits
) -> Float32[np.ndarray, "motion 6 3"]:
    """Blend plausible motion towards uniform motion until it keeps the limits; ends stay.

    Positions of a log jitter by centimetres, which at 0.1 s are many m/s2. Even motion has
    no acceleration and everywhere the mean turn, so the share of it needed is known.
    """
    share = np.linspace(0, 1, path.shape[1], dtype=np.float32)[:, None]
    even = path[:, -1:] * share  # [motion, 6, 3]
    apart = path - even
    apart[..., 2] = wrap_angle(apart[..., 2])

    _, accel_mps2, yaw_rad_s = _rates(path)
    mean_yaw_rad_s = np.abs(path[:, -1, 2]) / CLOCK.token_s
    most_mps2 = limits.accel_mps2[agent_type] * _SMOOTHED
    spare_rad_s = limits.yaw_rate_rad_s[agent_type] * _SMOOTHED - mean_yaw_rad_s
    kept_xy = most_mps2 / np.maximum(accel_mps2, most_mps2)
    kept_turn = spare_rad_s / np.maximum(yaw_rad_s - mean_yaw_rad_s, spare_rad_s)
    kept = np.stack([kept_xy, kept_xy, kept_turn], axis=-1)[:, None]
    eased = even + kept.astype(np.float32) * apart
    eased[..., 2] = wrap_angle(eased[..., 2])
    return np.where(kept < 1, eased, path)


def _rates(path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the highest speed, acceleration and yaw rate of each motion token."""
    step_m = np.diff(path[..., :2].astype(np.float64), axis=1)
    change_m = np.diff(step_m, axis=1)
    turn_rad = wrap_angle(np.diff(path[..., 2].astype(np.float64), axis=1))
    return (
        np.linalg.norm(step_m, axis=-1).max(axis=1) / CLOCK.step_s,
        np.linalg.norm(change_m, axis=-1).max(axis=1) / CLOCK.step_s**2,
        np.abs(turn_rad).max(axis=1) / CLOCK.step_s,
    )


def _follows_heading(path: np.ndarray, agent_type: int) -> np.ndarray:
    """Tell which motion tokens go along the heading, as far as the agent type must."""
    turn_rad = path[:, -1, 2]
    end_m = rotate(path[:, -1, :2], -turn_rad / 2)  # seen along the mean heading
    forward_m, left_m = end_m[:, 0], end_m[:, 1]
    straight = forward_m >= -MAX_REVERSE_MPS[agent_type] * CLOCK.token_s
    if agent_type == AgentType.PEDESTRIAN:
        return straight
    swing_m = 2 * MAX_PIVOT_M[agent_type] * np.sin(turn_rad / 2)
    straight &= left_m <= np.maximum(swing_m, 0) + MAX_SIDE_SLIP_M
    return straight & (left_m >= np.minimum(swing_m, 0) - MAX_SIDE_SLIP_M)
