"""A town as a ``RoadMap`` and its lights as ``Signals``, placed somewhere in the world."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.geometry import rotate
from infgen.scene import (
    FeatureKind,
    LaneType,
    LinkKind,
    RoadEdgeType,
    RoadMap,
    Side,
    Signals,
)
from infgen.sources.towns.curves import Points, resample
from infgen.sources.towns.streets import MPS_PER_MPH
from infgen.sources.towns.town import NO_GROUP, Strip, Town

MAP_SPACING_M = 1.0
MAP_GRID_M = 2.0**-8
"""Map points are rounded to it: no one can tell, and records pack better."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where in the world a town stands, and how its ground slopes.

    Attributes:
        turn_rad: World heading of the town's x axis.
        shift_m: World position of its junction.
        slope: Rise along world x and y, in metres per metre.
        height_m: Of the ground at the junction.
    """

    turn_rad: float
    shift_m: Float64[np.ndarray, "2"]
    slope: Float64[np.ndarray, "2"]
    height_m: float

    def xy_m(self, town_m: Float64[np.ndarray, "... 2"]) -> Float64[np.ndarray, "... 2"]:
        """Bring points of the town to the world."""
        turn_rad = np.full(town_m.shape[:-1], self.turn_rad)
        return rotate(town_m, turn_rad) + self.shift_m

    def ground_m(self, world_m: Float64[np.ndarray, "... 2"]) -> Float64[np.ndarray, "..."]:
        """Height of the ground at points of the world."""
        return self.height_m + (world_m - self.shift_m) @ self.slope

    def xyz_m(self, town_m: Points) -> Float64[np.ndarray, "point 3"]:
        """Bring points of the town to the ground of the world, rounded as a map is."""
        world_m = self.xy_m(town_m)
        world_m = np.column_stack([world_m, self.ground_m(world_m)])
        return np.round(world_m / MAP_GRID_M) * MAP_GRID_M


class _Features:
    """Map features as they are numbered, from 1."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.kinds: list[int] = []
        self.types: list[int] = []
        self.limits_mph: list[float] = []
        self.points_m: list[Float64[np.ndarray, "point 3"]] = []

    def add(
        self, kind: FeatureKind, xy_m: Points, of: int = 0, limit_mph: float = 0.0
    ) -> int:
        """Add a feature and return its id."""
        self.kinds.append(kind)
        self.types.append(of)
        self.limits_mph.append(limit_mph)
        self.points_m.append(self.place.xyz_m(xy_m))
        return len(self.kinds)


class _Relations:
    """Tables of relations between lanes, in the order of a record."""

    def __init__(self) -> None:
        self.link: list[tuple[int, int, int]] = []
        self.neighbour: list[tuple[int, int, int, tuple[int, int, int, int]]] = []
        self.boundary: list[tuple[int, int, int, int, tuple[int, int], int]] = []
        self.sign: list[tuple[int, int]] = []


@dataclass(frozen=True, slots=True)
class _Ids:
    """Feature ids of a town's parts; 0 for strips that maps do not show."""

    strips: list[int]
    lines: list[int]
    edges: list[int]


def draw_map(
    town: Town, place: Place, origin_xyz_m: Float64[np.ndarray, "3"]
) -> tuple[RoadMap, list[int]]:
    """Draw the map in metres around an origin; also return the lane id of every strip."""
    features, relations = _Features(place), _Relations()
    ids = _lines_of(town, features)
    for outlines, kind in (
        (town.crosswalks, FeatureKind.CROSSWALK),
        (town.bumps, FeatureKind.SPEED_BUMP),
        (town.driveways, FeatureKind.DRIVEWAY),
    ):
        for outline_m in outlines:
            features.add(kind, outline_m)
    for sign in town.signs:
        sign_id = features.add(FeatureKind.STOP_SIGN, sign.xy_m[None])
        relations.sign += [(sign_id, ids.strips[strip]) for strip in sign.strips]
    for row, strip in enumerate(town.strips):
        if ids.strips[row]:
            _relate(town, row, strip, ids, features, relations)
    return _road_map(features, relations, origin_xyz_m), ids.strips


def draw_signals(
    town: Town,
    road_map: RoadMap,
    lane_ids: Sequence[int],
    start_s: float,
    num_steps: int,
) -> Signals:
    """Record the lights of all lanes at every step, from a time of the town on."""
    lit = [
        (strip.gate.group, lane_ids[row])
        for row, strip in enumerate(town.strips)
        if strip.gate is not None and strip.gate.group != NO_GROUP and lane_ids[row]
    ]
    rows: list[tuple[int, int, int]] = []
    if town.plan is not None:
        for step in range(num_steps):
            time_s = start_s + step * CLOCK.step_s
            states = [town.plan.state(group, time_s) for group in (0, 1)]
            rows += [(step, lane, states[group]) for group, lane in lit]
    steps, lanes, shown = zip(*rows, strict=True) if rows else ((), (), ())
    stops = road_map.point_offsets[np.array(lanes, np.int64) - 1]
    return Signals(
        step=np.array(steps, np.int16),
        lane_id=np.array(lanes, np.int64),
        state=np.array(shown, np.int8),
        stop_xyz_m=road_map.xyz_m[stops],
    )


def _lines_of(town: Town, features: _Features) -> _Ids:
    strips = [
        features.add(
            FeatureKind.LANE,
            resample(strip.xy_m, MAP_SPACING_M),
            strip.lane_type,
            strip.limit_mps / MPS_PER_MPH if strip.lane_type != LaneType.BIKE_LANE else 0.0,
        )
        if strip.lane_type is not None
        else 0
        for strip in town.strips
    ]
    lines = [
        features.add(FeatureKind.ROAD_LINE, resample(line.xy_m, MAP_SPACING_M), line.kind)
        for line in town.lines
    ]
    edges = [
        features.add(
            FeatureKind.ROAD_EDGE, resample(edge_m, MAP_SPACING_M), RoadEdgeType.BOUNDARY
        )
        for edge_m in town.edges
    ]
    return _Ids(strips, lines, edges)


def _relate(
    town: Town,
    row: int,
    strip: Strip,
    ids: _Ids,
    features: _Features,
    relations: _Relations,
) -> None:
    """Add the rows of one lane to the tables."""
    lane = ids.strips[row]
    entries = [other for other, before in enumerate(town.strips) if row in before.exits]
    relations.link += [(lane, LinkKind.ENTRY, ids.strips[other]) for other in entries]
    relations.link += [(lane, LinkKind.EXIT, ids.strips[other]) for other in strip.exits]
    last = len(features.points_m[lane - 1]) - 1
    sides = (
        (Side.LEFT, strip.left, strip.left_line),
        (Side.RIGHT, strip.right, strip.right_line),
    )
    for side, beside, line in sides:
        if beside >= 0:
            other = ids.strips[beside]
            other_last = len(features.points_m[other - 1]) - 1
            relations.neighbour.append((lane, side, other, (0, last, 0, other_last)))
            if line >= 0:
                kind, at = int(town.lines[line].kind), len(relations.neighbour) - 1
                bound = (lane, side, ids.lines[line], kind, (0, last), at)
                relations.boundary.append(bound)
    for side, beside, line in sides:
        if line >= 0:
            kind = int(town.lines[line].kind)
            relations.boundary.append((lane, side, ids.lines[line], kind, (0, last), -1))
        elif side is Side.RIGHT and beside < 0 and strip.gate is None:
            edge = ids.edges[_nearest(town.edges, strip.xy_m)]
            relations.boundary.append((lane, side, edge, 0, (0, last), -1))


def _nearest(edges: Sequence[Points], xy_m: Points) -> int:
    """Edge that runs nearest to the middle of a strip."""
    middle_m = xy_m[len(xy_m) // 2]
    return int(np.argmin([np.linalg.norm(edge - middle_m, axis=1).min() for edge in edges]))


def _road_map(
    features: _Features, relations: _Relations, origin_xyz_m: Float64[np.ndarray, "3"]
) -> RoadMap:
    count = len(features.kinds)
    sizes = [len(points_m) for points_m in features.points_m]
    links = np.array(relations.link, np.int64).reshape(-1, 3)
    beside = [(*row[:3], *row[3]) for row in relations.neighbour]
    neighbours = np.array(beside, np.int64).reshape(-1, 7)
    along = [(*row[:4], *row[4], row[5]) for row in relations.boundary]
    boundaries = np.array(along, np.int64).reshape(-1, 7)
    signs = np.array(relations.sign, np.int64).reshape(-1, 2)
    return RoadMap(
        feature_id=np.arange(1, count + 1, dtype=np.int64),
        feature_kind=np.array(features.kinds, np.int8),
        feature_type=np.array(features.types, np.int8),
        speed_limit_mph=np.array(features.limits_mph, np.float32),
        interpolating=np.zeros(count, bool),
        point_offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        xyz_m=(np.concatenate(features.points_m) - origin_xyz_m).astype(np.float32),
        link_lane_id=links[:, 0],
        link_kind=links[:, 1].astype(np.int8),
        link_other_id=links[:, 2],
        neighbour_lane_id=neighbours[:, 0],
        neighbour_side=neighbours[:, 1].astype(np.int8),
        neighbour_other_id=neighbours[:, 2],
        neighbour_span=neighbours[:, 3:].astype(np.int32),
        boundary_lane_id=boundaries[:, 0],
        boundary_side=boundaries[:, 1].astype(np.int8),
        boundary_feature_id=boundaries[:, 2],
        boundary_type=boundaries[:, 3].astype(np.int8),
        boundary_span=boundaries[:, 4:6].astype(np.int32),
        boundary_neighbour=boundaries[:, 6].astype(np.int32),
        sign_id=signs[:, 0],
        sign_lane_id=signs[:, 1],
    )
