"""The map as it is drawn: lines by what they look like, thinned, and its traffic lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int64

from infgen.scene import (
    FeatureType,
    LaneType,
    RoadEdgeType,
    RoadLineType,
    RoadMap,
    Scene,
)
from infgen.tokens.signals import signals_at

TOLERANCE_M = 0.03
"""A thinned line strays no farther from the line of the log."""


class RoadLook(IntEnum):
    """What a map feature looks like, from the bottom up."""

    DRIVEWAY = 0
    LANE = 1
    FREEWAY = 2
    BIKE_LANE = 3
    CROSSWALK = 4
    SPEED_BUMP = 5
    WHITE_BROKEN = 6
    WHITE_SOLID = 7
    WHITE_DOUBLE = 8
    YELLOW_BROKEN = 9
    YELLOW_SOLID = 10
    YELLOW_DOUBLE = 11
    EDGE = 12
    MEDIAN = 13
    STOP_SIGN = 14


_LANES = {LaneType.FREEWAY: RoadLook.FREEWAY, LaneType.BIKE_LANE: RoadLook.BIKE_LANE}
_LINES = {
    RoadLineType.SOLID_SINGLE_WHITE: RoadLook.WHITE_SOLID,
    RoadLineType.SOLID_DOUBLE_WHITE: RoadLook.WHITE_DOUBLE,
    RoadLineType.BROKEN_SINGLE_YELLOW: RoadLook.YELLOW_BROKEN,
    RoadLineType.BROKEN_DOUBLE_YELLOW: RoadLook.YELLOW_BROKEN,
    RoadLineType.SOLID_SINGLE_YELLOW: RoadLook.YELLOW_SOLID,
    RoadLineType.SOLID_DOUBLE_YELLOW: RoadLook.YELLOW_DOUBLE,
    RoadLineType.PASSING_DOUBLE_YELLOW: RoadLook.YELLOW_DOUBLE,
}
_EDGES = {RoadEdgeType.MEDIAN: RoadLook.MEDIAN}
_PLAIN = {
    FeatureType.CROSSWALK: RoadLook.CROSSWALK,
    FeatureType.SPEED_BUMP: RoadLook.SPEED_BUMP,
    FeatureType.DRIVEWAY: RoadLook.DRIVEWAY,
    FeatureType.STOP_SIGN: RoadLook.STOP_SIGN,
}
STRIPE_M = 0.6
"""Width of a stripe of a crosswalk, and about the gap to the next."""


@dataclass(frozen=True, slots=True)
class DrawnMap:
    """Lines laid end to end, those of one look together, from the bottom up.

    Attributes:
        look: ``RoadLook`` of each line.
        bridge: Whether it is a lane that only bridges a crossing.
        offsets: First point of each line, and the number of points.
        xy_m: All points.
    """

    look: Int8[np.ndarray, " line"]
    bridge: Bool[np.ndarray, " line"]
    offsets: Int64[np.ndarray, " line+1"]
    xy_m: Float32[np.ndarray, "point 2"]

    def line(self, row: int) -> Float32[np.ndarray, "length 2"]:
        """Points of one line."""
        return self.xy_m[self.offsets[row] : self.offsets[row + 1]]


@dataclass(frozen=True, slots=True)
class Lights:
    """Traffic lights, one per signalled lane.

    Attributes:
        xy_m: Where the lane's traffic stops.
        heading_rad: Direction of the lane there.
        state: ``SignalClass`` at each step of the log.
    """

    xy_m: Float32[np.ndarray, "light 2"]
    heading_rad: Float32[np.ndarray, " light"]
    state: Int8[np.ndarray, "light step"]


def draw_map(road_map: RoadMap) -> DrawnMap:
    """Sort a map's features by their looks, and leave out points on straight stretches."""
    looks = [
        look_of(int(agent_type), int(type_))
        for agent_type, type_ in zip(
            road_map.feature_type, road_map.feature_subtype, strict=True
        )
    ]
    lines = [
        (look, bool(road_map.interpolating[row]), thin(part, TOLERANCE_M))
        for row, look in enumerate(looks)
        if look is not None
        for part in _parts(look, road_map.points(row)[:, :2])
    ]
    lines.sort(key=lambda line: line[0])
    return DrawnMap(
        look=np.array([look for look, _, _ in lines], dtype=np.int8),
        bridge=np.array([bridge for _, bridge, _ in lines], dtype=bool),
        offsets=np.cumsum([0, *[len(xy_m) for *_, xy_m in lines]], dtype=np.int64),
        xy_m=np.concatenate([np.zeros((0, 2), np.float32), *[xy_m for *_, xy_m in lines]]),
    )


def _parts(look: RoadLook, xy_m: np.ndarray) -> Sequence[np.ndarray]:
    return zebra(xy_m) if look is RoadLook.CROSSWALK else [xy_m]


def zebra(
    outline_m: Float32[np.ndarray, "corner 2"],
) -> Sequence[Float32[np.ndarray, "point 2"]]:
    """Cut a crosswalk of four corners into its stripes; others stay as they are."""
    corners = outline_m[:-1] if (outline_m[0] == outline_m[-1]).all() else outline_m
    if len(corners) != 4:
        return [outline_m]
    sides_m = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    # The way across is the longer one; it leads from a to b, and beside it from d to c.
    a, b, c, d = (
        corners
        if sides_m[[0, 2]].sum() > sides_m[[1, 3]].sum()
        else np.roll(corners, -1, axis=0)
    )
    count = max(1, round(float(np.linalg.norm(b - a)) / (2 * STRIPE_M)))
    ends = (np.arange(2 * count)[:, None] + 0.5) / (2 * count)
    near, far = a + ends * (b - a), d + ends * (c - d)
    stripes = np.stack([near[::2], near[1::2], far[1::2], far[::2]], axis=1)
    return list(stripes.astype(np.float32))


def look_of(agent_type: int, type_: int) -> RoadLook | None:
    """Return what a feature looks like; None for kinds that are not drawn."""
    if agent_type == FeatureType.LANE:
        return _LANES.get(LaneType(type_), RoadLook.LANE)
    if agent_type == FeatureType.ROAD_LINE:
        return _LINES.get(RoadLineType(type_), RoadLook.WHITE_BROKEN)
    if agent_type == FeatureType.ROAD_EDGE:
        return _EDGES.get(RoadEdgeType(type_), RoadLook.EDGE)
    return _PLAIN.get(FeatureType(agent_type))


def thin(
    xy_m: Float32[np.ndarray, "point 2"], tolerance_m: float
) -> Float32[np.ndarray, "kept 2"]:
    """Leave out points that are no farther than a tolerance from the line without them.

    The ends stay; between two that stay, the farthest point stays if it is too far from
    the straight line between them (Douglas and Peucker, 1973).
    """
    keep = np.zeros(len(xy_m), bool)
    keep[[0, -1] if len(xy_m) else []] = True
    spans = [(0, len(xy_m) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        away_m = _from_segment(xy_m[first + 1 : last], xy_m[first], xy_m[last])
        far = int(away_m.argmax())
        if away_m[far] > tolerance_m:
            middle = first + 1 + far
            keep[middle] = True
            spans += [(first, middle), (middle, last)]
    return xy_m[keep]


def _from_segment(xy_m: np.ndarray, start_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
    """Distances [point] from a straight line between two ends."""
    along = end_m - start_m
    length_sq = float(along @ along)
    share = ((xy_m - start_m) @ along) / length_sq if length_sq else np.zeros(len(xy_m))
    nearest = start_m + np.clip(share, 0, 1)[:, None] * along
    return np.linalg.norm(xy_m - nearest, axis=1)


def find_lights(scene: Scene) -> Lights:
    """Find where each signalled lane's traffic stops, and what its light shows when."""
    signals, steps = scene.signals, scene.tracks.num_steps
    lanes, first = np.unique(signals.lane_id, return_index=True)
    xy_m = signals.stop_xyz_m[first, :2]
    return Lights(
        xy_m=xy_m,
        heading_rad=np.array(
            [
                _lane_heading(scene.road_map, lane, stop)
                for lane, stop in zip(lanes.tolist(), xy_m, strict=True)
            ],
            dtype=np.float32,
        ),
        state=signals_at(signals, lanes, np.arange(steps)),
    )


def _lane_heading(road_map: RoadMap, lane_id: int, xy_m: np.ndarray) -> float:
    """Direction of a lane where it is nearest to a point; 0 for a lane not on the map."""
    rows = np.flatnonzero(road_map.feature_id == lane_id)
    points = road_map.points(int(rows[0]))[:, :2] if len(rows) else np.zeros((0, 2))
    if len(points) < 2:
        return 0.0
    near = int(((points - xy_m) ** 2).sum(axis=1).argmin())
    at = min(near, len(points) - 2)
    ahead = points[at + 1] - points[at]
    return float(np.arctan2(ahead[1], ahead[0]))
