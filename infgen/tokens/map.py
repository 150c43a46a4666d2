"""Map tokens: pieces of polylines of at most five metres, each matched to one shape.

Every lane, road line and road edge is a line; a crosswalk, speed bump or driveway is drawn
as its two long sides, each in both directions. Lines are broken where consecutive points do
not belong together, and cut every 5 m of arc length (SPEC 1.3).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int8, Int16, Int32, Int64

from infgen.geometry import rotate
from infgen.scene import FeatureType, LaneType, RoadEdgeType, RoadLineType, RoadMap
from infgen.tokens.vocabulary import MAP_SAMPLE_POINTS, MAP_SPACING_M, MapVocabulary

POINTS_PER_MAP_TOKEN = 11
INTERVALS_PER_MAP_TOKEN = POINTS_PER_MAP_TOKEN - 1

MAX_GAP_M = 10.0
"""Consecutive points farther apart are never joined."""
MAX_BENT_GAP_M = 3.0
"""... nor are points farther apart than this where the line also turns by more than ..."""
MAX_BEND_RAD = 0.1

MIN_FIRST_INTERVALS = 2
"""A line shorter than one piece becomes a token from so many half metres on ..."""
MIN_LAST_INTERVALS = 3
"""... and what is left of a longer one from so many."""

_MATCH_BLOCK = 512


class PointType(IntEnum):
    """Type of the points of a map token (ten types, after CatK)."""

    FREEWAY = 0
    SURFACE_STREET = 1
    STOP_CONTROLLED = 2
    BIKE_LANE = 3
    BOUNDARY = 4
    MEDIAN = 5
    BROKEN_LINE = 6
    SOLID_LINE = 7
    DOUBLE_LINE = 8
    CROSSING = 9


class PolylineType(IntEnum):
    """Type of the polyline a map token is part of."""

    LANE = 0
    ROAD_LINE = 1
    ROAD_EDGE = 2
    AREA = 3


_LANE_POINT_TYPES: Mapping[IntEnum, PointType] = {
    LaneType.UNDEFINED: PointType.SURFACE_STREET,
    LaneType.FREEWAY: PointType.FREEWAY,
    LaneType.SURFACE_STREET: PointType.SURFACE_STREET,
    LaneType.BIKE_LANE: PointType.BIKE_LANE,
}
_LINE_POINT_TYPES: Mapping[IntEnum, PointType] = {
    RoadLineType.UNKNOWN: PointType.BROKEN_LINE,
    RoadLineType.BROKEN_SINGLE_WHITE: PointType.BROKEN_LINE,
    RoadLineType.SOLID_SINGLE_WHITE: PointType.SOLID_LINE,
    RoadLineType.SOLID_DOUBLE_WHITE: PointType.DOUBLE_LINE,
    RoadLineType.BROKEN_SINGLE_YELLOW: PointType.BROKEN_LINE,
    RoadLineType.BROKEN_DOUBLE_YELLOW: PointType.BROKEN_LINE,
    RoadLineType.SOLID_SINGLE_YELLOW: PointType.SOLID_LINE,
    RoadLineType.SOLID_DOUBLE_YELLOW: PointType.DOUBLE_LINE,
    RoadLineType.PASSING_DOUBLE_YELLOW: PointType.DOUBLE_LINE,
}
_EDGE_POINT_TYPES: Mapping[IntEnum, PointType] = {
    RoadEdgeType.UNKNOWN: PointType.BOUNDARY,
    RoadEdgeType.BOUNDARY: PointType.BOUNDARY,
    RoadEdgeType.MEDIAN: PointType.MEDIAN,
}
_POLYLINE_TYPES: dict[FeatureType, tuple[PolylineType, Mapping[IntEnum, PointType]]] = {
    FeatureType.LANE: (PolylineType.LANE, _LANE_POINT_TYPES),
    FeatureType.ROAD_LINE: (PolylineType.ROAD_LINE, _LINE_POINT_TYPES),
    FeatureType.ROAD_EDGE: (PolylineType.ROAD_EDGE, _EDGE_POINT_TYPES),
}
_AREA_TYPES = (FeatureType.CROSSWALK, FeatureType.SPEED_BUMP, FeatureType.DRIVEWAY)


@dataclass(frozen=True, slots=True)
class MapPolylinePieces:
    """Map lines cut into pieces, before they are matched to a vocabulary.

    Pieces of one line are adjacent and run along it.

    Attributes:
        pose: First point of each piece, and the direction of its first interval.
        z_m: Height of the first point.
        curve_m: Eleven points, evenly spaced along the piece, in the frame of its pose.
        length_m: Arc length: 5 m, less at the end of a line.
        point_type: ``PointType``.
        polyline_type: ``PolylineType``.
        polyline: Line that the piece is part of, counted over the scene.
        feature_id: Map feature that the line was drawn from.
    """

    pose: Float32[np.ndarray, "map_token 3"]
    z_m: Float32[np.ndarray, " map_token"]
    curve_m: Float32[np.ndarray, "map_token 11 2"]
    length_m: Float32[np.ndarray, " map_token"]
    point_type: Int8[np.ndarray, " map_token"]
    polyline_type: Int8[np.ndarray, " map_token"]
    polyline: Int32[np.ndarray, " map_token"]
    feature_id: Int64[np.ndarray, " map_token"]

    @property
    def num_map_tokens(self) -> int:
        """Number of pieces."""
        return len(self.polyline)

    @property
    def sample_m(self) -> Float32[np.ndarray, "map_token 3 2"]:
        """First, middle and last point, in the frame of the piece's pose."""
        return self.curve_m[:, list(MAP_SAMPLE_POINTS)]


class _Polylines(NamedTuple):
    """All lines of a map: points laid end to end, and one row per line."""

    xyz_m: np.ndarray  # [point, 3], float64
    polyline: np.ndarray  # [point], ascending
    whole: np.ndarray  # [line]: never broken, whatever its gaps
    point_type: np.ndarray  # [line]
    polyline_type: np.ndarray  # [line]
    feature_id: np.ndarray  # [line]


class _Chains(NamedTuple):
    """Runs of points that belong together."""

    first: np.ndarray  # [chain]: first point
    last: np.ndarray  # [chain]: last point
    arc_m: np.ndarray  # [point]: arc length over all chains; no length between two


def cut_map_tokens(road_map: RoadMap) -> MapPolylinePieces:
    """Cut every line of a map into pieces of at most five metres."""
    lines = _join(_polylines(road_map), _area_sides(road_map))
    chains = _chains(lines)
    chain, start_m, end_m = _cuts(chains.arc_m[chains.last] - chains.arc_m[chains.first])
    xyz_m = _sample(lines, chains, chain, start_m, end_m)  # [road, 11, 3]

    step_m = xyz_m[:, 1, :2] - xyz_m[:, 0, :2]
    heading_rad = np.arctan2(step_m[:, 1], step_m[:, 0])
    away_m = xyz_m[..., :2] - xyz_m[:, :1, :2]
    curve_m = rotate(away_m, -heading_rad[:, None])
    line = lines.polyline[chains.first[chain]]
    return MapPolylinePieces(
        pose=np.column_stack([xyz_m[:, 0, :2], heading_rad]).astype(np.float32),
        z_m=xyz_m[:, 0, 2].astype(np.float32),
        curve_m=curve_m.astype(np.float32),
        length_m=(end_m - start_m).astype(np.float32),
        point_type=lines.point_type[line],
        polyline_type=lines.polyline_type[line],
        polyline=line.astype(np.int32),
        feature_id=lines.feature_id[line],
    )


def match_map_tokens(
    pieces: MapPolylinePieces, vocabulary: MapVocabulary
) -> Int16[np.ndarray, " map_token"]:
    """Find the shape nearest to each piece: least sum of squared gaps of three points."""
    return nearest_map_tokens(pieces.curve_m, vocabulary)


def nearest_map_tokens(
    curve_m: Float32[np.ndarray, "map_token 11 2"], vocabulary: MapVocabulary
) -> Int16[np.ndarray, " map_token"]:
    """Find the shape nearest to each curve in the frame of its piece.

    The first points coincide by construction, so four numbers decide. The squared gap, less
    what does not depend on the shape, is one matrix product; around the vocabulary's mean,
    so that float32 is enough.
    """
    shapes = vocabulary.sample_m[:, 1:].reshape(-1, 4)
    mean = shapes.mean(axis=0)
    shapes = shapes - mean
    weights = np.vstack([-2 * shapes.T, (shapes**2).sum(axis=1)])  # [5, shape]
    wanted = curve_m[:, list(MAP_SAMPLE_POINTS[1:])].reshape(-1, 4) - mean
    wanted = np.column_stack([wanted, np.ones_like(wanted[:, 0])])  # [road, 5]
    token = np.empty(len(wanted), dtype=np.int16)
    for start in range(0, len(wanted), _MATCH_BLOCK):
        rows = slice(start, start + _MATCH_BLOCK)
        token[rows] = (wanted[rows] @ weights).argmin(axis=1)
    return token


def _polylines(road_map: RoadMap) -> _Polylines:
    """Take lanes, road lines and road edges as they are drawn."""
    sizes = np.diff(road_map.point_offsets)
    polyline_type, point_type = _feature_types(road_map)
    rows = np.flatnonzero((polyline_type >= 0) & (sizes >= 2))
    kept = np.zeros(len(sizes), dtype=bool)
    kept[rows] = True
    xyz_m = road_map.xyz_m[np.repeat(kept, sizes)]
    return _Polylines(
        xyz_m=xyz_m.astype(np.float64),
        polyline=np.repeat(np.arange(len(rows)), sizes[rows]),
        whole=np.zeros(len(rows), dtype=bool),
        point_type=point_type[rows],
        polyline_type=polyline_type[rows],
        feature_id=road_map.feature_id[rows],
    )


def _feature_types(road_map: RoadMap) -> tuple[np.ndarray, np.ndarray]:
    """Give each feature its ``PolylineType`` (-1: none) and ``PointType``."""
    polyline_type = np.full(road_map.num_features, -1, dtype=np.int8)
    point_type = np.zeros(road_map.num_features, dtype=np.int8)
    for feature, (kind, points) in _POLYLINE_TYPES.items():
        table = np.array([points[key] for key in sorted(points)], dtype=np.int8)
        rows = road_map.rows(feature)
        polyline_type[rows] = kind
        point_type[rows] = table[np.clip(road_map.feature_subtype[rows], 0, len(table) - 1)]
    stop = (polyline_type == PolylineType.LANE) & np.isin(
        road_map.feature_id, road_map.sign_lane_id
    )
    point_type[stop] = PointType.STOP_CONTROLLED
    return polyline_type, point_type


def _area_sides(road_map: RoadMap) -> _Polylines:
    """Draw every crosswalk, speed bump and driveway as two long sides, there and back.

    Two opposite edges of the outline are its ends: the pair that is shortest together.
    What remains are the sides, of any number of points.
    """
    rows = np.flatnonzero(np.isin(road_map.feature_type, _AREA_TYPES))
    first, size = _outlines(road_map, rows)
    rows, first, size = rows[size >= 3], first[size >= 3], size[size >= 3]
    starts = np.cumsum(size) - size
    area = np.repeat(np.arange(len(rows)), size)  # [corner]
    place = np.arange(len(area)) - starts[area]  # [corner], 0 .. size - 1
    many = size[area]
    half = many // 2

    corner_m = road_map.xyz_m[first[area] + place].astype(np.float64)
    following = starts[area] + (place + 1) % many
    edge_m = np.linalg.norm(corner_m[following, :2] - corner_m[:, :2], axis=1)
    ends_m = edge_m + edge_m[starts[area] + (place + half) % many]
    by_area = np.lexsort((ends_m, area))
    start = place[by_area[starts]] + 1  # [area]: first corner after an end

    there = starts[area] + (start[area] + place) % many
    back = starts[area] + (start[area] + many - 1 - place) % many
    line = 4 * area + (place >= half)
    line_back = 4 * area + 2 + (place >= many - half)
    order = np.argsort(np.concatenate([line, line_back]), kind="stable")
    sides = np.full(4 * len(rows), PolylineType.AREA, dtype=np.int8)
    return _Polylines(
        xyz_m=corner_m[np.concatenate([there, back])[order]],
        polyline=np.concatenate([line, line_back])[order],
        whole=np.ones(len(sides), dtype=bool),
        point_type=np.full(len(sides), PointType.CROSSING, dtype=np.int8),
        polyline_type=sides,
        feature_id=np.repeat(road_map.feature_id[rows], 4),
    )


def _outlines(road_map: RoadMap, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give first point and number of corners of outlines; a closing point is not one."""
    first = road_map.point_offsets[rows]
    last = road_map.point_offsets[rows + 1] - 1
    held = last >= first
    closed = (last > first) & (
        road_map.xyz_m[np.where(held, first, 0)] == road_map.xyz_m[np.where(held, last, 0)]
    ).all(axis=1)
    return first, last + 1 - first - closed


def _join(one: _Polylines, two: _Polylines) -> _Polylines:
    """Lay the lines of two tables end to end."""
    shifted = two._replace(polyline=two.polyline + len(one.whole))
    return _Polylines(*(np.concatenate(pair) for pair in zip(one, shifted, strict=True)))


def _chains(lines: _Polylines) -> _Chains:
    """Break lines where consecutive points do not belong together."""
    step_m = np.diff(lines.xyz_m[:, :2], axis=0)
    gap_m = np.hypot(step_m[:, 0], step_m[:, 1])  # [point - 1]
    cut = np.diff(lines.polyline) > 0
    far = np.flatnonzero((gap_m > MAX_BENT_GAP_M) & ~cut & ~lines.whole[lines.polyline[1:]])
    cut[far] = (gap_m[far] > MAX_GAP_M) | _bends(step_m, cut, far)
    ends = np.flatnonzero(cut)
    arc_m = np.concatenate([[0.0], np.cumsum(np.where(cut, 0.0, gap_m))])
    return _Chains(np.append(0, ends + 1), np.append(ends, len(lines.polyline) - 1), arc_m)


def _bends(step_m: np.ndarray, new_line: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Say which intervals turn away from the one before, or after, in their line."""
    bends = np.zeros(len(far), dtype=bool)
    for beside in (far - 1, far + 1):
        beside = np.where((beside >= 0) & (beside < len(step_m)), beside, far)
        one_m, two_m = step_m[far], step_m[beside]
        cross = one_m[:, 0] * two_m[:, 1] - one_m[:, 1] * two_m[:, 0]
        turn_rad = np.arctan2(np.abs(cross), (one_m * two_m).sum(axis=1))
        bends |= ~new_line[beside] & (turn_rad > MAX_BEND_RAD)
    return bends


def _cuts(length_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Say where to cut chains of these lengths: chain, start and end of each piece."""
    # Half metres, a last short one included, as if the chain were resampled (SPEC 1.3).
    intervals = np.ceil(length_m / MAP_SPACING_M - 1e-6).astype(np.int64)
    full, rest = np.divmod(intervals, INTERVALS_PER_MAP_TOKEN)
    least = np.where(full > 0, MIN_LAST_INTERVALS, MIN_FIRST_INTERVALS)
    pieces = full + (rest >= least)
    chain = np.repeat(np.arange(len(length_m)), pieces)
    place = np.arange(len(chain)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start_m = place * (INTERVALS_PER_MAP_TOKEN * MAP_SPACING_M)
    end_m = np.minimum(start_m + INTERVALS_PER_MAP_TOKEN * MAP_SPACING_M, length_m[chain])
    return chain, start_m, end_m


def _sample(
    lines: _Polylines,
    chains: _Chains,
    chain: np.ndarray,
    start_m: np.ndarray,
    end_m: np.ndarray,
) -> np.ndarray:
    """Place eleven points evenly along each piece [road, 11, 3]."""
    share = np.arange(POINTS_PER_MAP_TOKEN) / INTERVALS_PER_MAP_TOKEN
    along_m = start_m[:, None] + (end_m - start_m)[:, None] * share
    first, last = chains.first[chain, None], chains.last[chain, None]
    arc_m = chains.arc_m[first] + along_m  # [road, 11]
    before = np.searchsorted(chains.arc_m, arc_m, side="right") - 1
    before = np.clip(before, first, last - 1)
    gap_m = chains.arc_m[before + 1] - chains.arc_m[before]
    part = (arc_m - chains.arc_m[before]) / np.where(gap_m > 0, gap_m, 1.0)
    point_m = lines.xyz_m[before]
    return point_m + part[..., None] * (lines.xyz_m[before + 1] - point_m)
