"""Scenes as WOMD ``Scenario`` records, and records as TFRecord files. Inverse of ``womd``.

Fields stand in ascending order of their numbers, as the official writer puts them. States
and map points are many and their messages have one fixed size, so each is one row of a
structured array, tags included.
"""

import gzip
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.scene import FeatureType, LinkType, RoadMap, Scene, Side, Signals, Tracks
from infgen.sources.tfrecord import frame
from infgen.sources.wire import BYTES, FIXED32, FIXED64, VARINT
from infgen.sources.wire_write import double, integer, key, message, varint

_LEVEL = 6
"""Of compression: half the time of the highest, and two bytes more in a hundred."""
_WIRE_DTYPES = {VARINT: "u1", FIXED64: "<f8", FIXED32: "<f4"}


_Fields = dict[str, tuple[int, int]]
"""Names of a message's fields to their number and wire type."""

_POINT: _Fields = {"x": (1, FIXED64), "y": (2, FIXED64), "z": (3, FIXED64)}
_STATE: _Fields = {
    "x": (2, FIXED64),
    "y": (3, FIXED64),
    "z": (4, FIXED64),
    "length": (5, FIXED32),
    "width": (6, FIXED32),
    "height": (7, FIXED32),
    "heading": (8, FIXED32),
    "velocity_x": (9, FIXED32),
    "velocity_y": (10, FIXED32),
    "valid": (11, VARINT),
}
_INVALID_STATE = b"\x58\x00"
"""The message of a state that says ``valid: false`` and nothing else."""


def encode_scenario(scene: Scene) -> bytes:
    """Write one scene as the bytes of a WOMD ``Scenario``.

    Positions go back to the world frame: the origin is added in float64.
    """
    origin = scene.origin_xyz_m
    roles = zip(scene.predict_row.tolist(), scene.predict_difficulty.tolist(), strict=True)
    return b"".join(
        [
            b"".join(double(1, time_s) for time_s in scene.timestamps_s.tolist()),
            _tracks(scene.tracks, origin),
            b"".join(integer(4, track) for track in scene.interest_id.tolist()),
            message(5, scene.scenario_id.encode()),
            integer(6, scene.ego),
            _dynamic_states(scene.signals, origin, scene.tracks.num_steps),
            _map_features(scene.road_map, origin),
            integer(10, scene.now),
            *(message(11, integer(1, row) + integer(2, level)) for row, level in roles),
        ]
    )


def write_tfrecord(path: Path, records: Iterable[bytes]) -> None:
    """Write records as a TFRecord, GZIP if its name ends in ``.gz``.

    Nothing in the file depends on when or under which name it was written.
    """
    path.write_bytes(tfrecord(records, zipped=path.suffix == ".gz"))


def tfrecord(records: Iterable[bytes], *, zipped: bool) -> bytes:
    """Return the bytes of a TFRecord of some records, GZIP or plain."""
    data = b"".join(frame(record) for record in records)
    return gzip.compress(data, _LEVEL, mtime=0) if zipped else data


def _tracks(tracks: Tracks, origin_xyz_m: Float64[np.ndarray, "3"]) -> bytes:
    kinds = tracks.agent_type.astype(int) + 1
    states = _states(tracks, origin_xyz_m)
    blank = _bytes_of(_rows(_STATE, **dict.fromkeys(_STATE, np.zeros(1))))
    unseen = (_bytes_of(states) == blank).all(axis=-1)  # [agent, step]
    parts = []
    for row, (track, kind) in enumerate(
        zip(tracks.id.tolist(), kinds.tolist(), strict=True)
    ):
        written = [
            message(3, _INVALID_STATE if skip else state.tobytes())
            for state, skip in zip(states[row], unseen[row].tolist(), strict=True)
        ]
        parts.append(message(2, integer(1, track) + integer(2, kind) + b"".join(written)))
    return b"".join(parts)


def _states(tracks: Tracks, origin_xyz_m: Float64[np.ndarray, "3"]) -> np.ndarray:
    """Messages [agent, step] of all states."""
    xyz_m = tracks.xyz_m.astype(np.float64) + origin_xyz_m
    return _rows(
        _STATE,
        x=xyz_m[..., 0],
        y=xyz_m[..., 1],
        z=xyz_m[..., 2],
        length=tracks.size_lwh_m[..., 0],
        width=tracks.size_lwh_m[..., 1],
        height=tracks.size_lwh_m[..., 2],
        heading=tracks.heading_rad,
        velocity_x=tracks.velocity_mps[..., 0],
        velocity_y=tracks.velocity_mps[..., 1],
        valid=tracks.valid,
    )


def _rows(layout: _Fields, **values: np.ndarray) -> np.ndarray:
    """Lay out one message of fixed size per value: every field's tag, then the value."""
    columns: list[tuple[str, str]] = []
    for name, (_, wire) in layout.items():
        columns += [(f"tag_{name}", "u1"), (name, _WIRE_DTYPES[wire])]
    rows = np.empty(next(iter(values.values())).shape, np.dtype(columns))
    for name, (number, wire) in layout.items():
        rows[f"tag_{name}"] = number << 3 | wire
        rows[name] = values[name]
    return rows


def _bytes_of(rows: np.ndarray) -> np.ndarray:
    """Bytes [..., byte] of every row of a structured array."""
    return rows[..., None].view("u1")


def _points(number: int, xyz_m: Float64[np.ndarray, "point 3"]) -> bytes:
    """Write points, each as field ``number`` holding a ``MapPoint``."""
    rows = _rows(_POINT, x=xyz_m[:, 0], y=xyz_m[:, 1], z=xyz_m[:, 2])
    head = key(number, BYTES) + varint(rows.itemsize)
    heads = np.tile(np.frombuffer(head, "u1"), (len(rows), 1))
    return np.hstack([heads, _bytes_of(rows)]).tobytes()


def _dynamic_states(signals: Signals, origin_xyz_m: np.ndarray, num_steps: int) -> bytes:
    """Write one message per step, also of steps without signals."""
    stops = _points(3, signals.stop_xyz_m.astype(np.float64) + origin_xyz_m)
    size = len(stops) // max(1, len(signals.step))
    states = zip(signals.lane_id.tolist(), signals.state.tolist(), strict=True)
    rows = [
        message(
            1, integer(1, lane) + integer(2, state) + stops[row * size : (row + 1) * size]
        )
        for row, (lane, state) in enumerate(states)
    ]
    ends = np.searchsorted(signals.step, np.arange(num_steps + 1))
    return b"".join(
        message(7, b"".join(rows[ends[step] : ends[step + 1]])) for step in range(num_steps)
    )


def _map_features(road_map: RoadMap, origin_xyz_m: np.ndarray) -> bytes:
    xyz_m = road_map.xyz_m.astype(np.float64) + origin_xyz_m
    tables = _Tables(road_map)
    parts = []
    for row, (feature, kind) in enumerate(
        zip(road_map.feature_id.tolist(), road_map.feature_type.tolist(), strict=True)
    ):
        points_m = xyz_m[road_map.point_offsets[row] : road_map.point_offsets[row + 1]]
        body = _feature(road_map, tables, row, points_m)
        parts.append(message(8, integer(1, feature) + message(kind, body)))
    return b"".join(parts)


def _feature(road_map: RoadMap, tables: "_Tables", row: int, points_m: np.ndarray) -> bytes:
    kind = FeatureType(road_map.feature_type[row])
    if kind == FeatureType.LANE:
        return _lane(road_map, tables, row, points_m)
    if kind in (FeatureType.ROAD_LINE, FeatureType.ROAD_EDGE):
        return integer(1, int(road_map.feature_subtype[row])) + _points(2, points_m)
    if kind == FeatureType.STOP_SIGN:
        lanes = road_map.sign_lane_id[tables.signs.get(int(road_map.feature_id[row]), [])]
        return b"".join(integer(1, lane) for lane in lanes.tolist()) + _points(2, points_m)
    return _points(1, points_m)


class _Tables:
    """Rows of the map's tables by what they belong to."""

    def __init__(self, road_map: RoadMap) -> None:
        own = np.where(road_map.boundary_neighbour < 0, road_map.boundary_lane_id, -1)
        links = zip(
            road_map.link_lane_id.tolist(), road_map.link_type.tolist(), strict=True
        )
        sides = zip(
            road_map.neighbour_lane_id.tolist(),
            road_map.neighbour_side.tolist(),
            strict=True,
        )
        self.links = _rows_by(links)
        self.neighbours = _rows_by(sides)
        self.boundaries = _rows_by(
            zip(own.tolist(), road_map.boundary_side.tolist(), strict=True)
        )
        self.shared = _rows_by(road_map.boundary_neighbour.tolist())
        self.signs = _rows_by(road_map.sign_id.tolist())


def _rows_by(keys: Iterable[Any]) -> dict[Any, list[int]]:
    """Row numbers of each key, ascending."""
    found: dict[Any, list[int]] = {}
    for row, owner in enumerate(keys):
        found.setdefault(owner, []).append(row)
    return found


def _lane(road_map: RoadMap, tables: _Tables, row: int, points_m: np.ndarray) -> bytes:
    lane = int(road_map.feature_id[row])
    parts = [
        double(1, float(road_map.speed_limit_mph[row])),
        integer(2, int(road_map.feature_subtype[row])),
        integer(3, int(road_map.interpolating[row])),
        _points(8, points_m),
    ]
    for number, link in ((9, LinkType.ENTRY), (10, LinkType.EXIT)):
        others = road_map.link_other_id[tables.links.get((lane, link), [])]
        parts += [integer(number, other) for other in others.tolist()]
    for number, side in ((11, Side.LEFT), (12, Side.RIGHT)):
        beside = tables.neighbours.get((lane, side), [])
        parts += [message(number, _neighbour(road_map, tables, at)) for at in beside]
    for number, side in ((13, Side.LEFT), (14, Side.RIGHT)):
        along = tables.boundaries.get((lane, side), [])
        parts += [message(number, _boundary(road_map, at)) for at in along]
    return b"".join(parts)


def _neighbour(road_map: RoadMap, tables: _Tables, at: int) -> bytes:
    spans = zip((2, 3, 4, 5), road_map.neighbour_span[at].tolist(), strict=True)
    shared = tables.shared.get(at, [])
    return b"".join(
        [
            integer(1, int(road_map.neighbour_other_id[at])),
            *(integer(number, index) for number, index in spans),
            *(message(6, _boundary(road_map, row)) for row in shared),
        ]
    )


def _boundary(road_map: RoadMap, at: int) -> bytes:
    first, last = road_map.boundary_span[at].tolist()
    feature = int(road_map.boundary_feature_id[at])
    kind = int(road_map.boundary_type[at])
    return integer(1, first) + integer(2, last) + integer(3, feature) + integer(4, kind)
