"""Boxes from positions on routes: poses, as bodies on two axles have them."""

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.sources.towns.demand import Users
from infgen.sources.towns.routes import Routes
from infgen.sources.towns.traffic import Traffic

AXLES = 0.6
"""Distance between a body's axles as a share of its length."""


def poses(
    routes: Routes, users: Users, traffic: Traffic
) -> Float64[np.ndarray, "user step 3"]:
    """Poses [user, step, 3] of everyone: x, y in metres, heading in radians."""
    half_m = (AXLES * users.size_lwh_m[:, 0] / 2)[:, None]
    front_m = routes.points(traffic.route, traffic.along_m + half_m)
    rear_m = routes.points(traffic.route, traffic.along_m - half_m)
    body_m = front_m - rear_m
    heading_rad = np.arctan2(body_m[..., 1], body_m[..., 0])
    left = np.stack([-np.sin(heading_rad), np.cos(heading_rad)], axis=-1)
    sway_m = _sway(users, traffic)
    aside_m = users.side_m[:, None] + sway_m + traffic.aside_m
    xy_m = (front_m + rear_m) / 2 + aside_m[..., None] * left
    sideways_mps = np.gradient(sway_m, CLOCK.step_s, axis=1) + traffic.aside_mps
    heading_rad += np.arctan2(sideways_mps, np.maximum(traffic.speed_mps, 1.0))
    return np.concatenate([xy_m, heading_rad[..., None]], axis=-1)


def _sway(users: Users, traffic: Traffic) -> Float64[np.ndarray, "user step"]:
    """How far left of their line users weave; by distance, so who stands is still."""
    odometer_m = np.cumsum(traffic.speed_mps, axis=1) * CLOCK.step_s
    phase_rad = 2 * np.pi * odometer_m / users.sway_length_m[:, None]
    return np.sin(phase_rad + users.sway_phase_rad[:, None]) * users.sway_m[:, None]
