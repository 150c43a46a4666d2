"""Motion samples made by rule: uniform motion along arcs, where logs show none.

A vocabulary must be able to follow any road user, or the chain of motion tokens runs away
from the log. Where logs hold no motion token nearby, a motion_grid of arcs within the
limits stands in.
"""

import numpy as np
from jaxtyping import Float32

from infgen.clock import CLOCK
from infgen.geometry import rotate
from infgen.scene import AgentType
from infgen.tokens.clustering.physical_limits import (
    MAX_REVERSE_MPS,
    MotionLimits,
    keeps_limits,
)
from infgen.tokens.vocabulary import BOX_LW_M

MIN_TURN_RADIUS_M = (4.0, 0.0, 1.0)
"""Smallest radius of an arc, by kind; a pedestrian turns on the spot."""

PIVOT_M = (1.4, 0.0, 0.5)
"""How far behind the centre of the box the point lies that goes along the arc."""

REVERSE_MPS = (4.0, 1.5, 1.0)
"""How fast a motion_grid goes backwards."""

MAX_LATERAL_MPS2 = 8.0
"""Sideways acceleration that tyres hold."""

SIDESTEP_MPS = 1.5
"""How fast a pedestrian goes in a direction that it does not face."""

COMFORT_MPS2, COMFORT_RAD_S = 3.0, 1.0
"""Sideways acceleration and yaw rate that are still ordinary."""


def make_fan(
    agent_type: int, limits: MotionLimits, spacing_m: float
) -> Float32[np.ndarray, "motion 6 3"]:
    """Make arcs of all lengths and turns of a kind, the most ordinary first.

    Args:
        agent_type: ``AgentType``.
        limits: What the arcs keep to.
        spacing_m: How far neighbouring arcs' box corners end apart, about.
    """
    length_m, turn_rad = _grid(agent_type, limits, spacing_m)
    effort = _effort(length_m, turn_rad, float(limits.speed_mps[agent_type]))
    path = _arcs(length_m, turn_rad, PIVOT_M[agent_type])
    if agent_type == AgentType.PEDESTRIAN:
        path, effort = _with_sidesteps(path, effort)
    order = np.lexsort((*path[:, -1].T, effort))
    path = path[order]
    return path[keeps_limits(path, agent_type, limits)]


def _with_sidesteps(path: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add slow motion tokens aside, whatever way a pedestrian faces."""
    slow = np.hypot(path[:, -1, 0], path[:, -1, 1]) <= SIDESTEP_MPS * CLOCK.token_s
    slow &= path[:, -1, 0] > 0
    paths, efforts = [path], [effort]
    for eighths in (1, -1, 2, -2, 3, -3):
        aside = path[slow]
        turn_rad = np.full(aside.shape[:2], eighths * np.pi / 4)
        xy_m = rotate(aside[..., :2].astype(np.float64), turn_rad)
        paths.append(np.concatenate([xy_m, aside[..., 2:]], axis=-1).astype(np.float32))
        efforts.append(effort[slow] + np.abs(eighths))
    return np.concatenate(paths), np.round(np.concatenate(efforts), 6)


def _grid(
    agent_type: int, limits: MotionLimits, spacing_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return length and turn of every arc, symmetric about straight on."""
    corner_m = np.hypot(*BOX_LW_M[agent_type]) / 2
    most_rad = min(np.pi, float(limits.yaw_rate_rad_s[agent_type]) * CLOCK.token_s)
    turns = int(most_rad / (spacing_m / corner_m))
    turn_rad = np.arange(-turns, turns + 1) * (spacing_m / corner_m)
    back = int(
        min(REVERSE_MPS[agent_type], MAX_REVERSE_MPS[agent_type])
        * CLOCK.token_s
        / spacing_m
    )
    ahead = int(float(limits.speed_mps[agent_type]) * CLOCK.token_s / spacing_m)
    length_m = np.arange(-back, ahead + 1) * spacing_m
    length_m, turn_rad = (x.ravel() for x in np.meshgrid(length_m, turn_rad))
    wide = np.abs(length_m) >= MIN_TURN_RADIUS_M[agent_type] * np.abs(turn_rad)
    wide &= np.abs(length_m * turn_rad) <= MAX_LATERAL_MPS2 * CLOCK.token_s**2
    return length_m[wide], turn_rad[wide]


def _effort(length_m: np.ndarray, turn_rad: np.ndarray, most_mps: float) -> np.ndarray:
    """Say how far from ordinary each arc is; rounded, so that left and right are equal."""
    speed_mps, yaw_rad_s = length_m / CLOCK.token_s, turn_rad / CLOCK.token_s
    effort = (speed_mps / (most_mps / 2)) ** 2
    effort += (speed_mps * yaw_rad_s / COMFORT_MPS2) ** 2 + (yaw_rad_s / COMFORT_RAD_S) ** 2
    return np.round(effort + (speed_mps < 0), 6)


def _arcs(
    length_m: np.ndarray, turn_rad: np.ndarray, pivot_m: float
) -> Float32[np.ndarray, "motion 6 3"]:
    """Draw a pivot along arcs at an even pace, the centre of the box ahead of it."""
    share = np.linspace(0, 1, CLOCK.steps_per_token + 1)
    turned_rad = turn_rad[:, None] * share  # [motion, 6]
    chord_m = length_m[:, None] * share * np.sinc(turned_rad / (2 * np.pi))
    x_m = chord_m * np.cos(turned_rad / 2) + pivot_m * (np.cos(turned_rad) - 1)
    y_m = chord_m * np.sin(turned_rad / 2) + pivot_m * np.sin(turned_rad)
    return np.stack([x_m, y_m, turned_rad], axis=-1).astype(np.float32)
