"""Setting-off delay: from a light turning green to the first in the queue driving off."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from infgen.clock import CLOCK
from infgen.metrics.proper.engineering.vehicles import STANDING_MPS, Vehicles, turned_rad
from infgen.scene import RoadMap, Signals, SignalState

STOP = (SignalState.ARROW_STOP, SignalState.STOP)
GO = (SignalState.ARROW_GO, SignalState.GO)
QUEUE_M = 12.0
"""The first in the queue has its middle no farther before the stop line ..."""
LANE_M = 2.0
"""... and no farther beside its lane."""
SAME_WAY_RAD = np.radians(45.0)


class Greens(NamedTuple):
    """Moments at which lights turn from red to green.

    Attributes:
        step: First green step, counted from the first after now.
        stop_m: Where the lane's traffic stops.
        way_rad: Direction of the lane there.
    """

    step: Int64[np.ndarray, " green"]
    stop_m: Float64[np.ndarray, "green 2"]
    way_rad: Float64[np.ndarray, " green"]


def find_greens(signals: Signals, road_map: RoadMap, now: int) -> Greens:
    """Find when lights turn green after now."""
    found: list[tuple[int, float, float, float]] = []
    for lane_id in np.unique(signals.lane_id).tolist():
        rows = np.flatnonzero(signals.lane_id == lane_id)
        way_m = _way_m(road_map, lane_id, signals.stop_xyz_m[rows[0], :2])
        if way_m is None:
            continue
        state, step = signals.state[rows], signals.step[rows].astype(np.int64)
        turns = np.isin(state[:-1], STOP) & np.isin(state[1:], GO)
        for at in np.flatnonzero(turns & (np.diff(step) == 1) & (step[1:] > now)).tolist():
            x_m, y_m = signals.stop_xyz_m[rows[at + 1], :2].tolist()
            way_rad = float(np.arctan2(way_m[1], way_m[0]))
            found.append((int(step[at + 1]) - now - 1, x_m, y_m, way_rad))
    table = np.array(found, dtype=np.float64).reshape(-1, 4)
    return Greens(table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3])


def delays_s(vehicles: Vehicles, greens: Greens) -> Float64[np.ndarray, " value"]:
    """Time from green until the vehicle that stands first at the line drives.

    Lines at which nobody stands, and vehicles that do not drive in sight, have no delay.
    """
    found = []
    for step, stop_m, way_rad in zip(*greens, strict=True):
        if step >= vehicles.near.shape[1]:
            continue
        ahead_m, aside_m = _before_line_m(vehicles, int(step), stop_m, way_rad)
        angle_rad = np.abs(turned_rad(way_rad[None], vehicles.heading_rad[:, step]))
        with np.errstate(invalid="ignore"):
            queues = vehicles.near[:, step] & (vehicles.speed_mps[:, step] < STANDING_MPS)
        queues &= (ahead_m > 0) & (ahead_m < QUEUE_M) & (aside_m < LANE_M)
        rows = np.flatnonzero(queues & (angle_rad < SAME_WAY_RAD))
        if len(rows):
            first = rows[ahead_m[rows].argmin()]
            with np.errstate(invalid="ignore"):
                drives = vehicles.speed_mps[first, step:] >= STANDING_MPS
            drives &= vehicles.near[first, step:]
            if drives.any():
                found.append(float(drives.argmax() * CLOCK.step_s))
    return np.array(found, dtype=np.float64)


def _before_line_m(
    vehicles: Vehicles, step: int, stop_m: np.ndarray, way_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far each vehicle is before a stop line, and beside its lane."""
    dx_m, dy_m = stop_m[0] - vehicles.x_m[:, step], stop_m[1] - vehicles.y_m[:, step]
    cos, sin = np.cos(way_rad), np.sin(way_rad)
    return cos * dx_m + sin * dy_m, np.abs(cos * dy_m - sin * dx_m)


def _way_m(road_map: RoadMap, lane_id: int, stop_m: np.ndarray) -> np.ndarray | None:
    """Vector along a lane at its point nearest to a stop; None if the map lacks it."""
    rows = np.flatnonzero(road_map.feature_id == lane_id)
    if not len(rows):
        return None
    points_m = road_map.points(int(rows[0]))[:, :2].astype(np.float64)
    if len(points_m) < 2:
        return None
    at = int(np.hypot(*(points_m - stop_m).T).argmin())
    at = min(at, len(points_m) - 2)
    return np.asarray(points_m[at + 1] - points_m[at])
