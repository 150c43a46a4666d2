"""The driven car: what its driver holds down becomes motion, tick by tick."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from infgen.clock import CLOCK
from infgen.rollout.bicycle import (
    SPEED,
    advance,
    stopping_acceleration,
    turn_wheels,
    wheelbase_of,
)

TICKS_PER_STEP = 4
TICKS_PER_TOKEN = TICKS_PER_STEP * CLOCK.steps_per_token
TICK_S = CLOCK.step_s / TICKS_PER_STEP
"""Controls are read so often."""
THROTTLE_MPS2, BRAKE_MPS2, ROLLING_MPS2 = 3.5, 7.5, 0.3
"""Full throttle from a stand, full brakes, and a car that rolls out."""
TOP_MPS, TOP_REVERSE_MPS = 33.0, 5.0
"""Throttle fades until it is gone at these speeds."""
SHIFT_MPS = 0.5
"""Slower than this, gears can be shifted."""
MIN_WHEELBASE_M = 1.0
"""An ego that is no car is steered like a short one."""


@dataclass(frozen=True, slots=True)
class Controls:
    """What the driver holds down.

    Attributes:
        throttle: 0 to 1.
        brake: 0 to 1.
        steer: -1 (right) to 1 (left).
    """

    throttle: float = 0.0
    brake: float = 0.0
    steer: float = 0.0


RELEASED = Controls()


@dataclass(frozen=True, slots=True)
class Car:
    """A car at one moment.

    Attributes:
        state: x, y, heading, speed (negative backwards).
        steering_rad: Angle of the front wheels.
        wheelbase_m: Distance of the axles.
        reverse: Whether the throttle drives backwards.
    """

    state: Float64[np.ndarray, "4"]
    steering_rad: float
    wheelbase_m: float
    reverse: bool = False

    @classmethod
    def at(cls, pose: Float32[np.ndarray, "3"], speed_mps: float, length_m: float) -> "Car":
        """Make a car with straight wheels."""
        state = np.array([*pose, speed_mps], dtype=np.float64)
        wheelbase_m = max(MIN_WHEELBASE_M, float(wheelbase_of(length_m)))
        return cls(state, 0.0, wheelbase_m)

    @property
    def pose(self) -> Float32[np.ndarray, "3"]:
        """Position of the box centre and heading."""
        return self.state[:3].astype(np.float32)

    @property
    def speed_mps(self) -> float:
        """Speed, negative backwards."""
        return float(self.state[SPEED])

    def drive(self, controls: Controls) -> "Car":
        """Drive one tick."""
        steering_rad = float(
            turn_wheels(
                self.steering_rad, controls.steer, self.speed_mps, self.wheelbase_m, TICK_S
            )
        )
        state = advance(
            self.state, self._acceleration(controls), steering_rad, self.wheelbase_m, TICK_S
        )
        return replace(self, state=state, steering_rad=steering_rad)

    def drive_token(self, controls: Controls) -> Float32[np.ndarray, "5 3"]:
        """Return the poses at the five steps of a token step with controls held."""
        car, poses = self, []
        for _ in range(CLOCK.steps_per_token):
            for _ in range(TICKS_PER_STEP):
                car = car.drive(controls)
            poses.append(car.pose)
        return np.stack(poses)

    def shift(self) -> "Car":
        """Shift between forward and reverse, if the car is slow enough."""
        slow = abs(self.speed_mps) < SHIFT_MPS
        return replace(self, reverse=self.reverse ^ slow)

    def _acceleration(self, controls: Controls) -> float:
        speed_mps, direction = self.speed_mps, -1.0 if self.reverse else 1.0
        if controls.brake or not controls.throttle:
            slowing_mps2 = ROLLING_MPS2 + BRAKE_MPS2 * controls.brake
            return float(stopping_acceleration(speed_mps, slowing_mps2, TICK_S))
        top_mps = TOP_REVERSE_MPS if self.reverse else TOP_MPS
        left = max(0.0, 1 - max(0.0, direction * speed_mps) / top_mps)
        return direction * controls.throttle * THROTTLE_MPS2 * left
