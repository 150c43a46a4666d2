"""Density, flow and speed of each lane, by Edie's definitions (1963)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.clock import CLOCK
from infgen.metrics.proper.engineering.vehicles import Vehicles, turned_rad
from infgen.scene import FeatureType, RoadMap
from infgen.spatial.nearest import nearest_by_cells

LANE_M = 2.0
"""A vehicle whose middle is nearer to a lane's middle drives in it ..."""
SAME_WAY_RAD = np.radians(45.0)
"""... if it goes its way."""
MIN_LENGTH_M = 30.0
"""Shorter lanes are left out: one vehicle more or less is all that they show."""
PERIOD_S = 10.0
"""Time over which a lane's traffic is averaged; the last period may be longer."""


class Lanes(NamedTuple):
    """Segments of the lanes of a map, and lanes that are measured.

    Attributes:
        start_m: First points of segments.
        along_m: Vectors to their last points.
        lane: Lane of each segment.
        length_m: Length of each lane.
        near: Lanes that lie within the radius of the ego now, and are long enough.
    """

    start_m: np.ndarray
    along_m: np.ndarray
    lane: Int64[np.ndarray, " segment"]
    length_m: Float64[np.ndarray, " lane"]
    near: Bool[np.ndarray, " lane"]


class LaneTraffic(NamedTuple):
    """Numbers of each measured lane and period; speed only where there is traffic."""

    density_per_km: Float64[np.ndarray, " value"]
    flow_per_h: Float64[np.ndarray, " value"]
    speed_mps: Float64[np.ndarray, " value"]


def read_lanes(
    road_map: RoadMap, ego_m: Float64[np.ndarray, "2"], radius_m: float
) -> Lanes:
    """Read the lanes of a map; measured are those that lie around the ego as a whole."""
    rows = road_map.rows(FeatureType.LANE)
    flat_m = road_map.xyz_m * np.array([1, 1, 0], dtype=np.float32)
    points = [np.arange(*road_map.point_offsets[row : row + 2]) for row in rows.tolist()]
    first = np.concatenate([np.zeros(0, np.int64), *(p[:-1] for p in points)])
    lane = np.repeat(np.arange(len(rows)), [len(p) - 1 for p in points])
    along_m = flat_m[first + 1] - flat_m[first]
    length_m = np.bincount(lane, np.hypot(*along_m[:, :2].T), minlength=len(rows))
    away_m = np.hypot(*(flat_m[:, :2] - ego_m).T)
    near = np.array([away_m[p].max(initial=0) < radius_m for p in points], dtype=bool)
    return Lanes(flat_m[first], along_m, lane, length_m, near & (length_m >= MIN_LENGTH_M))


def lane_traffic(vehicles: Vehicles, lanes: Lanes) -> LaneTraffic:
    """Measure all periods of all measured lanes, those without traffic too.

    Density is the time that vehicles spend in a lane over its length and the period, flow
    the distance that they go; speed is flow over density.
    """
    steps = np.arange(vehicles.near.shape[1])[vehicles.token_steps]
    periods = max(1, int(len(steps) * CLOCK.token_s // PERIOD_S))
    period = np.minimum(np.arange(len(steps)) * periods // max(1, len(steps)), periods - 1)
    row, at = np.nonzero(vehicles.near[:, steps] & ~np.isnan(vehicles.speed_mps[:, steps]))
    lane = _lane_of(vehicles, lanes, row, steps[at])
    inside = lane >= 0
    cell = lane[inside] * periods + period[at[inside]]
    speed_mps = vehicles.speed_mps[row[inside], steps[at[inside]]].astype(np.float64)
    size = len(lanes.length_m) * periods
    spent = np.bincount(cell, minlength=size).reshape(-1, periods)[lanes.near]
    gone = np.bincount(cell, speed_mps, minlength=size).reshape(-1, periods)[lanes.near]
    room_m = lanes.length_m[lanes.near][:, None] * np.bincount(period, minlength=periods)
    busy = spent > 0
    return LaneTraffic(
        density_per_km=(1000 * spent / room_m).reshape(-1),
        flow_per_h=(3600 * gone / room_m).reshape(-1),
        speed_mps=gone[busy] / spent[busy],
    )


def _lane_of(
    vehicles: Vehicles, lanes: Lanes, row: np.ndarray, step: np.ndarray
) -> Int64[np.ndarray, " place"]:
    """Lane that each vehicle drives in at a step; -1 for none."""
    if not len(lanes.start_m) or not len(row):
        return np.full(len(row), -1, dtype=np.int64)
    at_m = np.stack([vehicles.x_m[row, step], vehicles.y_m[row, step], 0 * step], axis=-1)
    at_m = at_m.astype(np.float32)
    nearest = nearest_by_cells(at_m, lanes.start_m, lanes.along_m)
    along_m, away_m = lanes.along_m[nearest, :2], (at_m - lanes.start_m[nearest])[:, :2]
    square = (along_m**2).sum(axis=1)
    share = (away_m * along_m).sum(axis=1) / np.where(square > 0, square, 1)
    beside_m = np.hypot(*(away_m - np.clip(share, 0, 1)[:, None] * along_m).T)
    way_rad = np.arctan2(along_m[:, 1], along_m[:, 0])
    angle_rad = np.abs(turned_rad(way_rad, vehicles.heading_rad[row, step]))
    inside = (beside_m < LANE_M) & (angle_rad < SAME_WAY_RAD)
    return np.where(inside, lanes.lane[nearest], -1)
