"""WOMD's ``MapFeature`` messages -> ``RoadMap``."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from infgen.scene import (
    FeatureType,
    LaneType,
    LinkType,
    RoadEdgeType,
    RoadLineType,
    RoadMap,
    Side,
)
from infgen.sources import wire
from infgen.sources.batch import Messages, decode, messages
from infgen.sources.tfrecord import RecordError
from infgen.sources.wire import BYTES, FIXED64, VARINT, Field, Spans, WireError, tag

POINT = {"x": tag(1, FIXED64), "y": tag(2, FIXED64), "z": tag(3, FIXED64)}

_ID = tag(1, VARINT)
_FEATURE_TYPES = {tag(kind, BYTES): kind for kind in FeatureType}
_POLYLINES = (FeatureType.LANE, FeatureType.ROAD_LINE, FeatureType.ROAD_EDGE)
_POINTS = {
    FeatureType.LANE: tag(8, BYTES),
    FeatureType.ROAD_LINE: tag(2, BYTES),
    FeatureType.ROAD_EDGE: tag(2, BYTES),
    FeatureType.STOP_SIGN: tag(2, BYTES),
    FeatureType.CROSSWALK: tag(1, BYTES),
    FeatureType.SPEED_BUMP: tag(1, BYTES),
    FeatureType.DRIVEWAY: tag(1, BYTES),
}
_SUBTYPES = {
    FeatureType.LANE: (tag(2, VARINT), max(LaneType)),
    FeatureType.ROAD_LINE: (tag(1, VARINT), max(RoadLineType)),
    FeatureType.ROAD_EDGE: (tag(1, VARINT), max(RoadEdgeType)),
}
_SPEED_LIMIT, _INTERPOLATING = tag(1, FIXED64), tag(3, VARINT)
_LINKS = {LinkType.ENTRY: 9, LinkType.EXIT: 10}
_NEIGHBOURS = {tag(11, BYTES): Side.LEFT, tag(12, BYTES): Side.RIGHT}
_BOUNDARIES = {tag(13, BYTES): Side.LEFT, tag(14, BYTES): Side.RIGHT}
_NEIGHBOUR_BOUNDARY = tag(6, BYTES)
_NEIGHBOUR = [tag(number, VARINT) for number in range(1, 6)]
_BOUNDARY = {
    "first": tag(1, VARINT),
    "last": tag(2, VARINT),
    "feature": tag(3, VARINT),
    "type": tag(4, VARINT),
}


class _Tables:
    """What is found while walking the features, in the order of the record."""

    def __init__(self) -> None:
        self.feature: list[tuple[int, int, int, float, bool, int]] = []
        self.link: list[tuple[int, int, int]] = []
        self.neighbour: list[tuple[int, int, list[int]]] = []
        self.boundary: list[tuple[int, int, int]] = []
        self.sign: list[tuple[int, int]] = []
        self.point_spans, self.boundary_spans = Spans(), Spans()

    def check_size(self) -> None:
        """Refuse a map with more relations than any real one, while memory lasts."""
        total = len(self.link) + len(self.neighbour) + len(self.boundary) + len(self.sign)
        if total > wire.MAX_FIELDS:
            raise RecordError(f"map has more than {wire.MAX_FIELDS} relations")


def read_road_map(
    data: bytes, features: Sequence[Field], origin_xyz_m: Float64[np.ndarray, "3"]
) -> RoadMap:
    """Decode all map features of a record, points in metres around an origin.

    Features of kinds that ``FeatureType`` does not know are passed over.

    Raises:
        WireError: if a message is not sound.
        RecordError: if two features have one id, a point is not finite, or a lane, road
            line or road edge has no points or all of several in one place.
    """
    tables = _Tables()
    for feature in features:
        _read_feature(data, feature, tables)
        tables.check_size()
    ids, kinds, types, speeds, interpolating, starts = _columns(tables.feature, 6)
    offsets = np.array([*starts, tables.point_spans.total], np.int64)
    road_map = RoadMap(
        feature_id=np.array(ids, np.int64),
        feature_type=np.array(kinds, np.int8),
        feature_subtype=np.array(types, np.int8),
        speed_limit_mph=_speeds(speeds),
        interpolating=np.array(interpolating, bool),
        point_offsets=offsets,
        xyz_m=read_points(data, messages(tables.point_spans), origin_xyz_m),
        **_links(tables),
        **_neighbours(tables),
        **_boundaries(data, tables),
        **_signs(tables),
    )
    check_road_map(road_map)
    return road_map


def read_points(
    data: bytes, points: Messages, origin_xyz_m: Float64[np.ndarray, "3"]
) -> Float32[np.ndarray, "point 3"]:
    """Decode ``MapPoint`` messages, in metres around an origin."""
    table = decode(data, points, POINT)
    local_m = np.empty((len(points), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(POINT):
            local_m[:, axis] = table[name] - origin_xyz_m[axis]
    return local_m


def _read_feature(data: bytes, feature: Field, tables: _Tables) -> None:
    fields = wire.walk(data, feature.start, feature.end)
    parts = [field for field in fields if field.tag in _FEATURE_TYPES]
    if len(parts) > 1:
        raise WireError(f"map feature at byte {feature.start} is of two kinds")
    if not parts:
        return
    (part,) = parts
    feature_id, kind = wire.signed(wire.last(fields, _ID)), _FEATURE_TYPES[part.tag]
    start = tables.point_spans.total
    inner = wire.split(data, part.start, part.end, _POINTS[kind], tables.point_spans)
    subtype, speed_mph, interpolating = 0, 0.0, False
    if kind in _SUBTYPES:
        subtype = wire.last_enum(inner, *_SUBTYPES[kind])
    if kind is FeatureType.LANE:
        speed_mph = _last_double(data, inner, _SPEED_LIMIT)
        interpolating = wire.last(inner, _INTERPOLATING) != 0
        _read_lane(data, feature_id, inner, tables)
    if kind is FeatureType.STOP_SIGN:
        if tables.point_spans.total - start > 1:
            raise WireError(f"stop sign {feature_id} has two positions")
        tables.sign += [(feature_id, lane) for lane in wire.varints(data, inner, 1)]
    tables.feature.append((feature_id, kind, subtype, speed_mph, interpolating, start))


def _read_lane(data: bytes, lane: int, fields: list[Field], tables: _Tables) -> None:
    for link, number in _LINKS.items():
        others = wire.varints(data, fields, number)
        tables.link += [(lane, link, other) for other in others]
    # By tag: writers differ in the order of fields, and the tables must not.
    for field in sorted(fields):
        if field.tag in _NEIGHBOURS:
            _read_neighbour(data, lane, field, tables)
        elif field.tag in _BOUNDARIES:
            tables.boundary.append((lane, _BOUNDARIES[field.tag], -1))
            tables.boundary_spans.add(field.start, field.end - field.start)


def _read_neighbour(data: bytes, lane: int, field: Field, tables: _Tables) -> None:
    spans, side = tables.boundary_spans, _NEIGHBOURS[field.tag]
    before = spans.total
    inner = wire.split(data, field.start, field.end, _NEIGHBOUR_BOUNDARY, spans)
    row = len(tables.neighbour)
    tables.boundary += [(lane, side, row)] * (spans.total - before)
    values = {field.tag: field.value for field in inner}
    tables.neighbour.append((lane, side, [values.get(key, 0) for key in _NEIGHBOUR]))


def _links(tables: _Tables) -> dict[str, np.ndarray]:
    lanes, kinds, others = _columns(tables.link, 3)
    return {
        "link_lane_id": np.array(lanes, np.int64),
        "link_type": np.array(kinds, np.int8),
        "link_other_id": np.array(others, np.int64),
    }


def _neighbours(tables: _Tables) -> dict[str, np.ndarray]:
    lanes, sides, values = _columns(tables.neighbour, 3)
    table = np.array(values, np.uint64).reshape(-1, len(_NEIGHBOUR)).astype(np.int64)
    return {
        "neighbour_lane_id": np.array(lanes, np.int64),
        "neighbour_side": np.array(sides, np.int8),
        "neighbour_other_id": table[:, 0],
        "neighbour_span": table[:, 1:].astype(np.int32),
    }


def _boundaries(data: bytes, tables: _Tables) -> dict[str, np.ndarray]:
    lanes, sides, rows = _columns(tables.boundary, 3)
    table = decode(data, messages(tables.boundary_spans), _BOUNDARY)
    types = np.where(table["type"] > max(RoadLineType), 0, table["type"])
    span = np.stack([table["first"], table["last"]], axis=1)
    return {
        "boundary_lane_id": np.array(lanes, np.int64),
        "boundary_side": np.array(sides, np.int8),
        "boundary_feature_id": table["feature"].astype(np.int64),
        "boundary_type": types.astype(np.int8),
        "boundary_span": span.astype(np.int64).astype(np.int32),
        "boundary_neighbour": np.array(rows, np.int32),
    }


def _signs(tables: _Tables) -> dict[str, np.ndarray]:
    signs, lanes = _columns(tables.sign, 2)
    return {
        "sign_id": np.array(signs, np.int64),
        "sign_lane_id": np.array(lanes, np.int64),
    }


def _columns(rows: Sequence[tuple[Any, ...]], width: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) if rows else [()] * width


def _speeds(speeds: Sequence[float]) -> Float32[np.ndarray, " feature"]:
    with np.errstate(over="ignore"):
        speeds_mph = np.array(speeds, np.float64).astype(np.float32)
    return np.where(np.isfinite(speeds_mph), speeds_mph, np.float32(0))


def _last_double(data: bytes, fields: list[Field], key: int) -> float:
    for field in reversed(fields):
        if field.tag == key:
            return float(struct.unpack_from("<d", data, field.start)[0])
    return 0.0


def check_road_map(road_map: RoadMap) -> None:
    """Refuse a map that nothing can be drawn or measured on.

    Raises:
        RecordError: if two features have one id, a point is not finite, or a lane, road
            line or road edge has no points or all of several in one place.
    """
    ids = road_map.feature_id
    ordered = np.sort(ids)
    if (twice := ordered[1:][ordered[1:] == ordered[:-1]]).size:
        raise RecordError(f"two map features have id {twice[0]}")
    finite = np.isfinite(road_map.xyz_m).all(axis=1)
    if not finite.all():
        row = _feature_of(road_map, int(np.argmin(finite)))
        raise RecordError(f"map feature {ids[row]} has a point that is not finite")
    lengths = np.diff(road_map.point_offsets)
    lines = np.isin(road_map.feature_type, _POLYLINES)
    if (empty := lines & (lengths == 0)).any():
        raise RecordError(f"polyline {ids[np.argmax(empty)]} has no points")
    flat = lines & (lengths > 1) & ~_moves(road_map)
    if flat.any():
        raise RecordError(f"polyline {ids[np.argmax(flat)]} has zero length")


def _moves(road_map: RoadMap) -> Bool[np.ndarray, " feature"]:
    """Tell which features have two successive points in different places."""
    steps = (np.diff(road_map.xyz_m, axis=0) != 0).any(axis=1)
    moved = np.concatenate([[0], np.cumsum(steps)])
    ends = np.maximum(road_map.point_offsets[1:] - 1, 0)
    starts = np.minimum(road_map.point_offsets[:-1], ends)
    moved = np.append(moved, moved[-1])
    return moved[ends] > moved[starts]


def _feature_of(road_map: RoadMap, point: int) -> int:
    return int(np.searchsorted(road_map.point_offsets, point, side="right")) - 1
