"""Boxes from positions on routes: poses, as bodies on two axles have them."""

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.scene import AgentKind
from infgen.sources.towns.demand import Users
from infgen.sources.towns.routes import Routes
from infgen.sources.towns.traffic import Traffic

AXLES = {AgentKind.VEHICLE: 0.6, AgentKind.PEDESTRIAN: 0.6, AgentKind.CYCLIST: 0.6}
"""Distance between a body's axles as a share of its length."""


def poses(
    routes: Routes, users: Users, traffic: Traffic
) -> Float64[np.ndarray, "user step 3"]:
    """Poses [user, step, 3] of everyone: x, y in metres, heading in radians."""
    axles_m = np.array([AXLES[AgentKind(kind)] for kind in range(3)])[users.kind]
    half_m = (axles_m * users.size_lwh_m[:, 0] / 2)[:, None]
    front_m = routes.points(traffic.route, traffic.along_m + half_m)
    rear_m = routes.points(traffic.route, traffic.along_m - half_m)
    body_m = front_m - rear_m
    heading_rad = np.arctan2(body_m[..., 1], body_m[..., 0])
    aside_m = _aside(users, traffic)
    normal = np.stack([-np.sin(heading_rad), np.cos(heading_rad)], axis=-1)
    xy_m = (front_m + rear_m) / 2 + aside_m[..., None] * normal
    return np.concatenate(
        [xy_m, (heading_rad + _drift(aside_m, traffic))[..., None]], axis=-1
    )


def _aside(users: Users, traffic: Traffic) -> Float64[np.ndarray, "user step"]:
    """How far left of their route users are."""
    odometer_m = np.cumsum(traffic.speed_mps, axis=1) * CLOCK.step_s
    phase_rad = 2 * np.pi * odometer_m / users.sway_length_m[:, None]
    sway_m = np.sin(phase_rad + users.sway_phase_rad[:, None]) * users.sway_m[:, None]
    return users.side_m[:, None] + sway_m + traffic.aside_m


def _drift(
    aside_m: Float64[np.ndarray, "user step"], traffic: Traffic
) -> Float64[np.ndarray, "user step"]:
    """How far a sideways motion turns the heading."""
    sideways_mps = np.gradient(aside_m, CLOCK.step_s, axis=1)
    sideways_mps = np.where(traffic.present, sideways_mps, 0.0)
    return np.arctan2(sideways_mps, np.maximum(traffic.speed_mps, 1.0))
