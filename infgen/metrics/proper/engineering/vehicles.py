"""The vehicles around the ego after now, of which all else is read."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.metrics.kinematics import central_difference, speed, speed_valid
from infgen.metrics.traffic import Traffic
from infgen.scene import AgentType

STANDING_MPS = 0.5
"""Slower vehicles stand."""


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Vehicles, the ego among them, at the steps after now.

    Attributes:
        x_m: Box centres.
        y_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        length_m: Of the boxes.
        width_m: Of the boxes.
        speed_mps: In the plane; NaN where a neighbour in time is not seen.
        accel_mps2: Change of the speed; NaN likewise.
        near: Seen within the radius.
    """

    x_m: Float32[np.ndarray, "vehicle step"]
    y_m: Float32[np.ndarray, "vehicle step"]
    heading_rad: Float32[np.ndarray, "vehicle step"]
    length_m: Float32[np.ndarray, " vehicle"]
    width_m: Float32[np.ndarray, " vehicle"]
    speed_mps: Float32[np.ndarray, "vehicle step"]
    accel_mps2: Float32[np.ndarray, "vehicle step"]
    near: Bool[np.ndarray, "vehicle step"]

    @property
    def token_steps(self) -> slice:
        """Ends of token steps, where things that change slowly are looked at."""
        return slice(CLOCK.steps_per_token - 1, None, CLOCK.steps_per_token)


def see_vehicles(traffic: Traffic, radius_m: float, num_steps: int) -> Vehicles:
    """Read the vehicles of a log or rollout at the first steps after now.

    Args:
        traffic: The log or rollout.
        radius_m: Vehicles nearer to the ego are around it.
        num_steps: How many steps.
    """
    motion, first = traffic.motion, traffic.now + 1
    stop = first + num_steps
    x_m, y_m = motion.x_m[0, :, :stop], motion.y_m[0, :, :stop]
    valid = motion.valid[0, :, :stop]
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    rows = np.flatnonzero(motion.agent_type == AgentType.VEHICLE)
    nan = np.float32(np.nan)
    speed_mps = np.where(speed_valid(valid), speed(x_m, y_m), nan)[rows]
    accel_mps2 = central_difference(speed_mps) / np.float32(CLOCK.step_s)
    return Vehicles(
        x_m=x_m[rows, first:],
        y_m=y_m[rows, first:],
        heading_rad=motion.heading_rad[0, rows, first:stop],
        length_m=motion.size_lwh_m[rows, 0],
        width_m=motion.size_lwh_m[rows, 1],
        speed_mps=speed_mps[:, first:],
        accel_mps2=accel_mps2[:, first:],
        near=(valid & (away_m < radius_m))[rows, first:],
    )


def turned_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Give the turn from one heading to another, in [-pi, pi)."""
    return np.asarray(wrap_angle(other - one))
