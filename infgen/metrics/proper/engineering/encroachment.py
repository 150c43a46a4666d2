"""Post-encroachment time: from leaving a place to a crossing vehicle getting there."""

import numpy as np
from jaxtyping import Float64, Int64

from infgen.clock import CLOCK
from infgen.metrics.proper.engineering.vehicles import STANDING_MPS, Vehicles, turned_rad

CELL_M = 1.5
"""Places are cells of a lattice this wide."""
ALONG, ACROSS = 5, 3
"""Points of a box that are in places: every metre or so of a car."""
CROSSING_RAD = np.radians(30.0)
"""Vehicles that meet a place at a lesser angle follow or merge, and do not cross."""
MAX_S = 10.0
"""Later encounters are none."""


def encroachments_s(vehicles: Vehicles) -> Float64[np.ndarray, " value"]:
    """Least time between two crossing vehicles over all places that both pass.

    Allen, Shin and Cooper (1978). One value per pair that follow each other directly in
    some place; 0 where the second is there before the first has left.
    """
    vehicle, step, cell = _visits(vehicles)
    order = np.lexsort((step, vehicle, cell))
    vehicle, step, cell = vehicle[order], step[order], cell[order]
    starts = np.ones(len(cell), dtype=bool)
    starts[1:] = (cell[1:] != cell[:-1]) | (vehicle[1:] != vehicle[:-1])
    first = np.flatnonzero(starts)
    last = np.append(first[1:], len(cell))[: len(first)] - 1
    # One row per place and vehicle, in the order of their arrival at the place.
    who, place, enter, leave = vehicle[first], cell[first], step[first], step[last]
    order = np.lexsort((who, enter, place))
    who, place, enter, leave = (x[order] for x in (who, place, enter, leave))
    same = place[1:] == place[:-1]
    one, two = who[:-1][same], who[1:][same]
    came, went, gone = enter[1:][same], enter[:-1][same], leave[:-1][same]
    heading_rad = vehicles.heading_rad
    angle_rad = np.abs(turned_rad(heading_rad[one, went], heading_rad[two, came]))
    time_s = np.maximum(came - gone, 0) * CLOCK.step_s
    crosses = (angle_rad > CROSSING_RAD) & (angle_rad < np.pi - CROSSING_RAD)
    crosses &= time_s < MAX_S
    pair = one[crosses] * len(heading_rad) + two[crosses]
    pairs, which = np.unique(pair, return_inverse=True)
    least_s = np.full(len(pairs), np.inf)
    np.minimum.at(least_s, which, time_s[crosses])
    return least_s


def _visits(
    vehicles: Vehicles,
) -> tuple[
    Int64[np.ndarray, " visit"], Int64[np.ndarray, " visit"], Int64[np.ndarray, " visit"]
]:
    """Vehicle, step and place of every point of a moving vehicle's box."""
    with np.errstate(invalid="ignore"):
        moving = vehicles.near & (vehicles.speed_mps >= STANDING_MPS)
    vehicle, step = np.nonzero(moving)
    along = np.linspace(-0.5, 0.5, ALONG)[:, None] * vehicles.length_m[vehicle, None, None]
    across = np.linspace(-0.5, 0.5, ACROSS) * vehicles.width_m[vehicle, None, None]
    heading_rad = vehicles.heading_rad[vehicle, step][:, None, None]
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    x_m = vehicles.x_m[vehicle, step][:, None, None] + cos * along - sin * across
    y_m = vehicles.y_m[vehicle, step][:, None, None] + sin * along + cos * across
    column = np.floor(x_m / CELL_M).astype(np.int64)
    row = np.floor(y_m / CELL_M).astype(np.int64)
    cell = (column << 32) + row
    points = ALONG * ACROSS
    return np.repeat(vehicle, points), np.repeat(step, points), cell.reshape(-1)
