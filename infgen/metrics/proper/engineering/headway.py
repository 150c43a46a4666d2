"""Time headway: how long a vehicle takes to where the one ahead of it is now."""

import numpy as np
from jaxtyping import Float64

from infgen.metrics.proper.engineering.vehicles import Vehicles, turned_rad

FOLLOWING_MPS = 1.0
"""Slower vehicles follow nobody."""
SAME_WAY_RAD = np.radians(45.0)
"""Vehicles that turn away by more do not lead."""
MAX_S = 10.0
"""Beyond it a vehicle does not follow."""


def headways_s(vehicles: Vehicles) -> Float64[np.ndarray, " value"]:
    """Gap between bumpers over the speed of the follower, at the ends of token steps.

    The leader is the nearest vehicle ahead that goes the same way and overlaps the
    follower's width.
    """
    found = []
    for step in range(vehicles.near.shape[1])[vehicles.token_steps]:
        there = np.flatnonzero(vehicles.near[:, step])
        moving = there[vehicles.speed_mps[there, step] > FOLLOWING_MPS]
        gap_m = _gaps_m(vehicles, moving, there, step).min(axis=1, initial=np.inf)
        time_s = gap_m / vehicles.speed_mps[moving, step]
        found.append(time_s[time_s < MAX_S])
    return np.concatenate([np.zeros(0), *found])


def _gaps_m(
    vehicles: Vehicles, followers: np.ndarray, leaders: np.ndarray, step: int
) -> Float64[np.ndarray, "follower leader"]:
    """Gaps between bumpers along the follower's heading; infinite where nobody is led."""
    heading_rad = vehicles.heading_rad[followers, step][:, None].astype(np.float64)
    dx_m = vehicles.x_m[leaders, step] - vehicles.x_m[followers, step][:, None]
    dy_m = vehicles.y_m[leaders, step] - vehicles.y_m[followers, step][:, None]
    ahead_m = np.cos(heading_rad) * dx_m + np.sin(heading_rad) * dy_m
    aside_m = np.abs(np.cos(heading_rad) * dy_m - np.sin(heading_rad) * dx_m)
    half_l_m, half_w_m = vehicles.length_m / 2, vehicles.width_m / 2
    gap_m = ahead_m - half_l_m[followers][:, None] - half_l_m[leaders]
    turn_rad = turned_rad(heading_rad, vehicles.heading_rad[leaders, step])
    leads = (aside_m < half_w_m[followers][:, None] + half_w_m[leaders]) & (gap_m > 0)
    return np.where(leads & (np.abs(turn_rad) < SAME_WAY_RAD), gap_m, np.inf)
