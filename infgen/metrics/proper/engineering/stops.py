"""How long vehicles stop, and how long agents stay around the ego."""

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.metrics.proper.engineering.vehicles import STANDING_MPS, Vehicles
from infgen.metrics.traffic import Traffic

MIN_STOP_S = 1.0
"""Shorter stops are none."""


def stops_s(vehicles: Vehicles) -> Float64[np.ndarray, " value"]:
    """Durations of the stops that both begin and end in sight: parked cars have none."""
    with np.errstate(invalid="ignore"):
        stands = vehicles.near & (vehicles.speed_mps < STANDING_MPS)
        drives = vehicles.near & (vehicles.speed_mps >= STANDING_MPS)
    edge = np.diff(np.pad(stands.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    vehicle, first = np.nonzero(edge == 1)
    _, after = np.nonzero(edge == -1)  # The same vehicles in the same order.
    last_step = stands.shape[1] - 1
    whole = (first > 0) & (after <= last_step)
    before, after_step = np.maximum(first - 1, 0), np.minimum(after, last_step)
    whole &= drives[vehicle, before] & drives[vehicle, after_step]
    time_s = (after - first)[whole] * CLOCK.step_s
    return time_s[time_s >= MIN_STOP_S - 1e-9]


def stays_s(
    traffic: Traffic, radius_m: float, num_steps: int
) -> Float64[np.ndarray, " value"]:
    """Time that each agent, the ego apart, is within the radius in the steps after now."""
    motion, first = traffic.motion, traffic.now + 1
    steps = slice(first, first + num_steps)
    x_m, y_m = motion.x_m[0, :, steps], motion.y_m[0, :, steps]
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    near = motion.valid[0, :, steps] & (away_m < radius_m)
    near[traffic.ego] = False
    count = near.sum(axis=1)
    return count[count > 0] * CLOCK.step_s
