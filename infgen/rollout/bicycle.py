"""The kinematic bicycle model: how a car moves that is steered and accelerated.

Pure functions over packed states [..., 4]: x and y of the box centre in metres, heading in
radians, speed in m/s (negative in reverse). The box centre lies midway between the axles;
wheels do not slip (Kong et al., "Kinematic and dynamic vehicle models for autonomous
driving control design", IV 2015). The environment and ``infgen drive`` move their egos so;
what a driver may ask of a car, and how a car stops, each of them says itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from infgen.geometry import wrap_angle

X, Y, HEADING, SPEED = range(4)
"""Columns of a state."""
WHEELBASE_SHARE = 0.6
"""Distance of the axles over the length of the box: of most cars 0.57 to 0.63."""
MAX_STEERING_RAD = 0.6
"""Largest angle of the front wheels, to either side."""

_Values = float | int | Float[np.ndarray, "..."]


class VehicleLimits(NamedTuple):
    """What a driver may ask of a car.

    Attributes:
        max_steering_rad: Largest angle of the front wheels.
        max_lateral_mps2: Largest lateral acceleration: it limits steering at speed.
        steering_rate_radps: How fast the front wheels turn.
    """

    max_steering_rad: float = MAX_STEERING_RAD
    max_lateral_mps2: float = 5.0
    steering_rate_radps: float = 1.0


def wheelbase_of(length_m: _Values) -> _Values:
    """Return the distance of the axles of a box so long."""
    return WHEELBASE_SHARE * length_m


def curvature_per_m(steering_rad: _Values, wheelbase_m: _Values) -> _Values:
    """Return the curvature of the centre's path: positive to the left.

    With a slip angle ``b = atan(tan(steering) / 2)``, ``cos(b) tan(steering) / wheelbase``.
    """
    slip_rad = np.arctan(np.tan(steering_rad) / 2)
    return np.cos(slip_rad) * np.tan(steering_rad) / wheelbase_m


def follow_arc(
    pose: Float64[np.ndarray, "*batch 3"],
    way_m: _Values,
    steering_rad: _Values,
    wheelbase_m: _Values,
) -> Float64[np.ndarray, "*batch 3"]:
    """Move on a way with constant steering: an arc, followed exactly.

    Args:
        pose: x, y, heading.
        way_m: Length of the centre's path; negative in reverse.
        steering_rad: Angle of the front wheels, positive to the left.
        wheelbase_m: Distance of the axles.
    """
    turn_rad = curvature_per_m(steering_rad, wheelbase_m) * way_m
    slip_rad = np.arctan(np.tan(steering_rad) / 2)
    # The chord of an arc; np.sinc(x) is sin(pi x) / (pi x).
    chord_m = way_m * np.sinc(turn_rad / 2 / np.pi)
    direction_rad = pose[..., HEADING] + slip_rad + turn_rad / 2
    return np.stack(
        [
            pose[..., X] + chord_m * np.cos(direction_rad),
            pose[..., Y] + chord_m * np.sin(direction_rad),
            wrap_angle(np.asarray(pose[..., HEADING] + turn_rad)),
        ],
        axis=-1,
    )


def advance(
    state: Float64[np.ndarray, "*batch 4"],
    acceleration_mps2: _Values,
    steering_rad: _Values,
    wheelbase_m: _Values,
    seconds: float,
) -> Float64[np.ndarray, "*batch 4"]:
    """Move on with constant acceleration and steering.

    A step of 0.1 s and ten of 0.01 s lead to the same place. Nothing stops at speed 0: see
    ``stopping_acceleration``.

    Args:
        state: x, y, heading, speed.
        acceleration_mps2: Along the path.
        steering_rad: Angle of the front wheels, positive to the left.
        wheelbase_m: Distance of the axles.
        seconds: How long.
    """
    speed_mps = state[..., SPEED]
    way_m = speed_mps * seconds + acceleration_mps2 * seconds**2 / 2
    pose = follow_arc(state[..., :SPEED], way_m, steering_rad, wheelbase_m)
    speed_mps = speed_mps + acceleration_mps2 * seconds
    return np.concatenate([pose, speed_mps[..., None]], axis=-1)


def stopping_acceleration(
    speed_mps: _Values, deceleration_mps2: _Values, seconds: float
) -> _Values:
    """Return the acceleration of a car that brakes and, once it stands, stays.

    Args:
        speed_mps: Now; negative in reverse.
        deceleration_mps2: Of the brakes, 0 or more.
        seconds: Length of the step: a car that would stop within it stands at its end.
    """
    most = np.minimum(deceleration_mps2, np.abs(speed_mps) / seconds)
    return -np.sign(speed_mps) * most


def turn_wheels(
    steering_rad: _Values,
    wanted: _Values,
    speed_mps: _Values,
    wheelbase_m: _Values,
    seconds: float,
    limits: VehicleLimits = VehicleLimits(),  # noqa: B008  # It is immutable.
) -> _Values:
    """Turn the front wheels towards where they are wanted, as fast and far as may be.

    Args:
        steering_rad: Their angle now.
        wanted: Share of the largest angle at this speed: -1 (right) to 1 (left).
        speed_mps: The faster, the smaller that angle.
        wheelbase_m: Distance of the axles.
        seconds: How long.
        limits: Of angle, angle over time and lateral acceleration.
    """
    square = np.maximum(np.square(speed_mps), 1e-6)
    # At small slip angles the curvature is tan(steering) / wheelbase.
    allowed_rad = np.arctan(wheelbase_m * limits.max_lateral_mps2 / square)
    most_rad = np.minimum(limits.max_steering_rad, allowed_rad)
    target_rad = np.clip(wanted, -1, 1) * most_rad
    step_rad = limits.steering_rate_radps * seconds
    turned_rad = steering_rad + np.clip(target_rad - steering_rad, -step_rad, step_rad)
    return np.clip(turned_rad, -limits.max_steering_rad, limits.max_steering_rad)
