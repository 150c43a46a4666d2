"""Vehicles on roads, as a test says."""

import numpy as np

from infgen.metrics.placement import Events
from infgen.metrics.proper.engineering.vehicles import see_vehicles
from infgen.metrics.traffic import Traffic
from tests.metrics.moving import STEP_S, boxes

NOW = 1
RADIUS_M = 75.0


def traffic(*paths, now=NOW, **more) -> Traffic:
    """Traffic whose ego is the first path, from paths as ``moving.boxes`` takes them."""
    nothing = np.zeros(0, np.int16), np.zeros(0, np.float32)
    motion = boxes(*paths, **more)
    return Traffic("by hand", 0, now, 0, motion, Events(*nothing, *nothing))


def vehicles(*paths, **more):
    """Vehicles after now, as far as the paths go; the ego stands at the origin."""
    steps = more.setdefault("steps", 61)
    ego = (0.0, 0.0, 0.0, 0.0)
    return see_vehicles(traffic(ego, *paths, **more), RADIUS_M, steps - 1 - NOW)


def path(x_m, y_m=0.0, heading_rad=0.0):
    """Poses [step, 3] at places that are given step by step."""
    x_m, y_m, heading_rad = np.broadcast_arrays(x_m, y_m, heading_rad)
    return np.column_stack([x_m, y_m, heading_rad])


def at_speeds(start_m, *speeds):
    """Places along a line: (speed in m/s, steps) one after the other."""
    moved_m = np.concatenate([np.full(steps, speed * STEP_S) for speed, steps in speeds])
    return start_m + np.concatenate([[0.0], np.cumsum(moved_m)])
