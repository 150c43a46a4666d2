"""Outlines of agents in their own frame.

A car has a windscreen, a cyclist is an arrow, a pedestrian a disc with a nose. The player's
scripts draw the same.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from infgen.scene import AgentType
from infgen.views.scene.style import AGENTS

_CORNER_POINTS = 5


class Shape(NamedTuple):
    """Outlines of one agent, x ahead, in metres.

    Attributes:
        body: Its outline.
        mark: Its windscreen; empty where it has none.
        dot: Middle and radius of the dot it wears if it was inserted.
    """

    body: Float64[np.ndarray, "point 2"]
    mark: Float64[np.ndarray, "point 2"]
    dot: tuple[float, float]


def shape_of(agent_type: int, length_m: float, width_m: float) -> Shape:
    """Return what an agent looks like."""
    none, dot = np.zeros((0, 2)), (0.0, AGENTS.dot * width_m)
    if agent_type == AgentType.VEHICLE:
        back = -AGENTS.dot_back * length_m
        return Shape(_car(length_m, width_m), _screen(length_m, width_m), (back, dot[1]))
    if agent_type == AgentType.PEDESTRIAN:
        return Shape(_walker(max(length_m, width_m) / 2), none, dot)
    half = max(width_m, length_m / 2) / 2
    if agent_type == AgentType.CYCLIST:
        corners = [(length_m / 2, 0.0), (-length_m / 2, half), (-length_m / 4, 0.0)]
        return Shape(np.array([*corners, (-length_m / 2, -half)]), none, dot)
    diamond = [(length_m / 2, 0), (0, width_m / 2), (-length_m / 2, 0), (0, -width_m / 2)]
    return Shape(np.array(diamond), none, dot)


def disc(
    middle: tuple[float, float], radius: float, points: int = 20
) -> Float64[np.ndarray, "point 2"]:
    """Corners of a disc."""
    return np.array(middle) + radius * _circle(points)


@lru_cache
def _circle(points: int) -> Float64[np.ndarray, "point 2"]:
    angle = 2 * np.pi * np.arange(points) / points
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _car(length_m: float, width_m: float) -> np.ndarray:
    front = min(AGENTS.front * width_m, length_m / 3)
    rear = AGENTS.rear * width_m
    corners = [(1, 1, front), (-1, 1, rear), (-1, -1, rear), (1, -1, front)]
    parts = []
    for at, (ahead, left, radius) in enumerate(corners):
        middle = ahead * (length_m / 2 - radius), left * (width_m / 2 - radius)
        angle = np.pi / 2 * (at + np.linspace(0, 1, _CORNER_POINTS))
        arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        parts.append(np.array(middle) + radius * arc)
    return np.concatenate(parts)


def _screen(length_m: float, width_m: float) -> np.ndarray:
    base = length_m / 2 - min(AGENTS.screen_base * length_m, AGENTS.screen_base_most_m)
    tip = length_m / 2 - min(AGENTS.screen_tip * length_m, AGENTS.screen_tip_most_m)
    below, above = AGENTS.screen_base_half * width_m, AGENTS.screen_tip_half * width_m
    return np.array([(base, below), (tip, above), (tip, -above), (base, -below)])


def _walker(radius_m: float) -> np.ndarray:
    angle = np.linspace(np.pi / 4, 7 * np.pi / 4, 16)
    arc = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([arc, [[AGENTS.beak * radius_m, 0.0]]])
