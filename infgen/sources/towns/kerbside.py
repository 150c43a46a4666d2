"""What stands beside the road: buildings that hide, parked cars, driveways, speed bumps."""

import numpy as np
from jaxtyping import Float64

from infgen.geometry import to_local
from infgen.sources.towns.arms import Arm, Verge
from infgen.sources.towns.curves import Points, headings
from infgen.sources.towns.town import Strip

BUILDING_CLEAR_M = 1.5
"""No path comes nearer to a building."""
_PARKING_PITCH_M = 6.6


def draw_buildings(
    arms: tuple[Arm, ...], strips: tuple[Strip, ...], rng: np.random.Generator
) -> Float64[np.ndarray, "building 5"]:
    """Line the arms with blocks [x, y, heading, length, width], clear of every path."""
    found = [_row_of_buildings(arm, side, rng) for arm in arms for side in (-1, 1)]
    blocks = np.concatenate([*found, np.empty((0, 5))])
    paths_m = np.concatenate([strip.xy_m for strip in strips])
    points = np.column_stack([paths_m, np.zeros(len(paths_m))])
    inside = np.abs(to_local(points[None], blocks[:, None, :3]))[..., :2]
    reach_m = blocks[:, None, 3:] / 2 + BUILDING_CLEAR_M
    return blocks[~(inside < reach_m).all(axis=-1).any(axis=-1)]


def _row_of_buildings(
    arm: Arm, side: int, rng: np.random.Generator
) -> Float64[np.ndarray, "building 5"]:
    """Draw blocks along one side of an arm, with gaps between them."""
    count = 8
    length_m = rng.uniform(10.0, 26.0, count)
    depth_m = rng.uniform(8.0, 14.0, count)
    gap_m = rng.uniform(2.0, 22.0, count)
    setback_m = rng.uniform(2.0, 6.0, count)
    centre_m = np.cumsum(length_m + gap_m) - length_m / 2
    rows = []
    for along, deep, back, long in zip(centre_m, depth_m, setback_m, length_m, strict=True):
        if along + long / 2 < arm.length_m:
            left_m = side * (arm.walk_m + back + deep / 2)
            line_m = arm.outward(left_m, along, along + 1.0)
            rows.append([*line_m[0], headings(line_m)[0], long, deep])
    return np.array(rows).reshape(-1, 5)


def draw_parked(
    arms: tuple[Arm, ...], rng: np.random.Generator
) -> Float64[np.ndarray, "parked 6"]:
    """Fill parking lanes with cars [x, y, heading, length, width, height]."""
    rows = [np.empty((0, 6))]
    for arm in arms:
        if arm.verge is Verge.PARKING:
            rows += [_parked_row(arm, side, rng) for side in (-1, 1)]
    return np.concatenate(rows)


def _parked_row(
    arm: Arm, side: int, rng: np.random.Generator
) -> Float64[np.ndarray, "parked 6"]:
    taken = np.arange(12.0, arm.length_m - 8.0, _PARKING_PITCH_M)
    taken = taken[rng.random(len(taken)) < rng.uniform(0.1, 0.7)]
    rows = []
    for along in taken + rng.uniform(-0.4, 0.4, len(taken)):
        left_m = side * (arm.lanes_m + Verge.PARKING.value / 2) + rng.normal(0.0, 0.08)
        line_m = arm.outward(left_m, along, along + 1.0)
        facing = 0.0 if side < 0 else np.pi
        heading_rad = headings(line_m)[0] + facing + rng.normal(0.0, 0.015)
        size = rng.normal([4.7, 1.88, 1.6], [0.25, 0.06, 0.12])
        rows.append([*line_m[0], heading_rad, *size])
    return np.array(rows).reshape(-1, 6)


def draw_driveways(arms: tuple[Arm, ...], rng: np.random.Generator) -> tuple[Points, ...]:
    """Cut a driveway through the pavement of some arms."""
    made = []
    for arm in arms:
        if rng.random() < 0.5:
            along, side = rng.uniform(30.0, 100.0), rng.choice([-1, 1])
            made.append(
                _band(arm, side * arm.half_m, side * (arm.half_m + 4.0), along, 5.0)
            )
    return tuple(made)


def draw_bumps(arms: tuple[Arm, ...], rng: np.random.Generator) -> tuple[Points, ...]:
    """Lay a speed bump across some slow arms."""
    slow = [arm for arm in arms if arm.limit_mph <= 25 and rng.random() < 0.4]
    return tuple(_band(arm, arm.lanes_m, -arm.lanes_m, 50.0, 1.2) for arm in slow)


def _band(
    arm: Arm, left_m: float, other_left_m: float, along_m: float, wide_m: float
) -> Points:
    """Outline of what lies between two parallels and two distances from the mouth."""
    near = arm.outward(left_m, along_m, along_m + wide_m)
    far = arm.outward(other_left_m, along_m, along_m + wide_m)
    return np.array([near[0], far[0], far[-1], near[-1]])
