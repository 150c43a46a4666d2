"""Speeds and accelerations by central differences, as the official metric takes them.

Time runs along the last axis. A difference needs both neighbours, so it is NaN at the ends;
what the values of unobserved steps do to it is left in, and ``speed_valid`` says where.
Everything is float32, in the order of the official arithmetic: bin edges are near.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from infgen.clock import CLOCK

STEP_S = np.float32(CLOCK.step_s)
HALF_TURN_RAD = np.float32(np.pi)
TURN_RAD = np.float32(2 * np.pi)

Series = Float32[np.ndarray, "... step"]


@dataclass(frozen=True, slots=True)
class Kinematics:
    """How boxes move at each step.

    Attributes:
        speed_mps: Length of the velocity, z included.
        accel_mps2: Change of the speed; negative when braking.
        yaw_rate_rad_s: Turning speed, counter-clockwise.
        yaw_accel_rad_s2: Change of the turning speed.
    """

    speed_mps: Float32[np.ndarray, "... step"]
    accel_mps2: Float32[np.ndarray, "... step"]
    yaw_rate_rad_s: Float32[np.ndarray, "... step"]
    yaw_accel_rad_s2: Float32[np.ndarray, "... step"]


def measure_kinematics(
    x_m: Series, y_m: Series, z_m: Series, heading_rad: Series
) -> Kinematics:
    """Measure the four kinematic features of every box at every step."""
    speed_mps = speed(x_m, y_m, z_m)
    turn_rad = _wrap(2 * central_difference(heading_rad)) / 2  # per step
    # The official metric wraps the difference of turns, not of turning speeds.
    turn_change_rad = _wrap(2 * central_difference(turn_rad)) / 2
    return Kinematics(
        speed_mps=speed_mps,
        accel_mps2=central_difference(speed_mps) / STEP_S,
        yaw_rate_rad_s=turn_rad / STEP_S,
        yaw_accel_rad_s2=turn_change_rad / STEP_S**2,
    )


def speed(x_m: Series, y_m: Series, z_m: Series | None = None) -> Series:
    """Speed in m/s, in three dimensions or, without ``z_m``, in the plane."""
    squares = central_difference(x_m) ** 2 + central_difference(y_m) ** 2
    if z_m is not None:
        squares = squares + central_difference(z_m) ** 2
    return np.sqrt(squares) / STEP_S


def central_difference(values: Series) -> Series:
    """Half the difference of the two neighbours in time; NaN at both ends."""
    change = np.full_like(values, np.nan)
    change[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return change


def speed_valid(valid: Bool[np.ndarray, "... step"]) -> Bool[np.ndarray, "... step"]:
    """Whether both neighbours in time are valid. Applied twice: for accelerations."""
    both = np.zeros_like(valid)
    both[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return both


def _wrap(angle_rad: Series) -> Series:
    return (angle_rad + HALF_TURN_RAD) % TURN_RAD - HALF_TURN_RAD
