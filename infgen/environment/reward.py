"""Rewards: what a step of a batch of environments is worth."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64

PER_METRE = 0.1
CRASH = -5.0
"""Reward of a collision, and of leaving the road."""


@dataclass(frozen=True, slots=True)
class DrivingStep:
    """What happened to each environment of a batch in one step.

    Attributes:
        seconds: How long the step was.
        progress_m: Way along the route; negative backwards.
        distance_m: Way driven.
        route_offset_m: Distance to the route after the step.
        speed_mps: After the step.
        accel_mps2: In its last 0.1 s.
        yaw_rate_rad_s: In its last 0.1 s.
        collided: Whether the ego's box overlapped another.
        off_road: Whether it left the road.
        route_ended: Whether it reached the end of the route.
        timed_out: Whether the episode lasted as long as it may.
    """

    seconds: float
    progress_m: Float64[np.ndarray, " environment"]
    distance_m: Float64[np.ndarray, " environment"]
    route_offset_m: Float64[np.ndarray, " environment"]
    speed_mps: Float64[np.ndarray, " environment"]
    accel_mps2: Float64[np.ndarray, " environment"]
    yaw_rate_rad_s: Float64[np.ndarray, " environment"]
    collided: Bool[np.ndarray, " environment"]
    off_road: Bool[np.ndarray, " environment"]
    route_ended: Bool[np.ndarray, " environment"]
    timed_out: Bool[np.ndarray, " environment"]

    @property
    def terminated(self) -> Bool[np.ndarray, " environment"]:
        """Whether an episode ended in a collision or off the road."""
        return self.collided | self.off_road

    @property
    def truncated(self) -> Bool[np.ndarray, " environment"]:
        """Whether it ended at the end of its route or of its time."""
        return (self.route_ended | self.timed_out) & ~self.terminated


@runtime_checkable
class Reward(Protocol):
    """Any function from a step of all environments to a reward for each."""

    def __call__(self, step: DrivingStep, /) -> Float64[np.ndarray, " environment"]:
        """Return the reward [environment] of a step."""
        ...


def default_reward(step: DrivingStep) -> Float64[np.ndarray, " environment"]:
    """Return 0.1 per metre along the route, and -5 for a collision or leaving the road."""
    crashes = step.collided.astype(np.float64) + step.off_road
    return PER_METRE * step.progress_m + CRASH * crashes
