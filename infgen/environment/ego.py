"""The driven cars of a batch of environments, and how actions move them.

Two kinds of action. A kinematic bicycle (``infgen.rollout.bicycle``) takes an acceleration
and the steering angle of its front wheel; a waypoint is the pose that the car has at the
end of the step. Cars do not drive backwards with a bicycle: braking ends at a stop.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from infgen.clock import CLOCK
from infgen.geometry import to_world
from infgen.rollout.bicycle import (
    MAX_STEERING_RAD,
    curvature_per_m,
    follow_arc,
    wheelbase_of,
)

ACCEL_MPS2 = (-8.0, 4.0)
"""Strongest braking and acceleration of a bicycle."""
MAX_SPEED_MPS = 40.0
"""A bicycle does not get faster."""
WAYPOINT_MPS = ((-10.0, 40.0), (-10.0, 10.0))
"""Least and greatest way of a waypoint, ahead and to the left, over the seconds to it."""
WAYPOINT_RAD_S = 1.5
"""Greatest turn to a waypoint, over the seconds to it."""

Action = Literal["bicycle", "waypoint"]


@dataclass(frozen=True, slots=True)
class EgoState:
    """The driven cars at one 0.1 s step.

    Attributes:
        pose: x, y, heading of the box centre, in the frame of the scene.
        speed_mps: Along the way the car moves.
        accel_mps2: In the step that led here.
        steering_rad: The same; 0 with waypoints.
        yaw_rate_rad_s: The same.
    """

    pose: Float64[np.ndarray, "environment 3"]
    speed_mps: Float64[np.ndarray, " environment"]
    accel_mps2: Float64[np.ndarray, " environment"]
    steering_rad: Float64[np.ndarray, " environment"]
    yaw_rate_rad_s: Float64[np.ndarray, " environment"]

    @classmethod
    def at(
        cls,
        pose: Float64[np.ndarray, "environment 3"],
        speed_mps: Float64[np.ndarray, " environment"],
    ) -> "EgoState":
        """Return cars of which no action is known."""
        none = np.zeros_like(speed_mps)
        return cls(pose, speed_mps, none, none, none)

    def where(self, chosen: np.ndarray, other: "EgoState") -> "EgoState":
        """Take the chosen cars [environment] from here and the rest from another state."""
        return EgoState(
            np.where(chosen[:, None], self.pose, other.pose),
            np.where(chosen, self.speed_mps, other.speed_mps),
            np.where(chosen, self.accel_mps2, other.accel_mps2),
            np.where(chosen, self.steering_rad, other.steering_rad),
            np.where(chosen, self.yaw_rate_rad_s, other.yaw_rate_rad_s),
        )


def action_bounds(
    action: Action, seconds: float
) -> tuple[Float32[np.ndarray, " value"], Float32[np.ndarray, " value"]]:
    """Return the least and the greatest action of one car.

    Args:
        action: Its kind: (acceleration m/s2, steering angle rad), or a pose in the ego
            frame (x m ahead, y m to the left, heading rad).
        seconds: How long an action lasts.
    """
    if action == "bicycle":
        low, high = (ACCEL_MPS2[0], -MAX_STEERING_RAD), (ACCEL_MPS2[1], MAX_STEERING_RAD)
        return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
    ahead, aside = WAYPOINT_MPS
    low_high = np.array([ahead, aside, (-WAYPOINT_RAD_S, WAYPOINT_RAD_S)]) * seconds
    return low_high[:, 0].astype(np.float32), low_high[:, 1].astype(np.float32)


def drive(
    action: Action,
    values: Float64[np.ndarray, "environment value"],
    state: EgoState,
    length_m: Float32[np.ndarray, " environment"],
    steps: int,
) -> list[EgoState]:
    """Return the cars at each of the steps that an action lasts."""
    states = []
    for step in range(steps):
        if action == "bicycle":
            state = _drive_bicycle(state, values[:, 0], values[:, 1], length_m)
        else:
            # What is left of the way, in equal parts: a straight line.
            share = 1.0 / (steps - step)
            if step:
                values = _rest(values, share_driven=1.0 / (steps - step + 1))
            state = _drive_to(state, values * share)
        states.append(state)
    return states


def _drive_bicycle(
    state: EgoState,
    accel_mps2: Float64[np.ndarray, " environment"],
    steering_rad: Float64[np.ndarray, " environment"],
    length_m: Float32[np.ndarray, " environment"],
) -> EgoState:
    """Drive one 0.1 s step."""
    before, seconds = state.speed_mps, CLOCK.step_s
    speed = np.clip(before + accel_mps2 * seconds, 0.0, MAX_SPEED_MPS)
    # Who stops or reaches the greatest speed within the step does so before its end.
    changing_s = np.full_like(speed, seconds)
    changes = accel_mps2 != 0
    np.divide(speed - before, accel_mps2, out=changing_s, where=changes)
    way_m = (before + speed) / 2 * changing_s + speed * (seconds - changing_s)
    wheelbase_m = wheelbase_of(length_m)
    return EgoState(
        pose=follow_arc(state.pose, way_m, steering_rad, wheelbase_m),
        speed_mps=speed,
        accel_mps2=(speed - before) / seconds,
        steering_rad=steering_rad,
        yaw_rate_rad_s=curvature_per_m(steering_rad, wheelbase_m) * way_m / seconds,
    )


def _drive_to(state: EgoState, waypoint: Float64[np.ndarray, "environment 3"]) -> EgoState:
    """Move each car to a pose in its own frame within one 0.1 s step."""
    seconds = CLOCK.step_s
    speed = np.hypot(waypoint[:, 0], waypoint[:, 1]) / seconds
    return EgoState(
        to_world(waypoint, state.pose),
        speed,
        (speed - state.speed_mps) / seconds,
        np.zeros_like(speed),
        waypoint[:, 2] / seconds,
    )


def _rest(
    waypoint: Float64[np.ndarray, "environment 3"], share_driven: float
) -> Float64[np.ndarray, "environment 3"]:
    """Return a waypoint in the frame of a car that has driven a share of the way to it."""
    rest = waypoint * (1 - share_driven)
    turned_rad = -waypoint[:, 2] * share_driven
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    x_m = cos * rest[:, 0] - sin * rest[:, 1]
    y_m = sin * rest[:, 0] + cos * rest[:, 1]
    return np.stack([x_m, y_m, rest[:, 2]], axis=1)
