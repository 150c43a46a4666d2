"""Map archives of Argoverse 2 (JSON) -> ``RoadMap``."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.scene import FeatureType, LaneType, LinkType, RoadEdgeType, RoadLineType, Side
from infgen.sources.argoverse2.categories import LANE_TYPES, MARK_TYPES, NO_MARK
from infgen.sources.argoverse2.drivable import road_edges
from infgen.sources.ids import integer_ids
from infgen.sources.map_builder import MapBuilder
from infgen.sources.polylines import (
    SPACING_M,
    arc_length_m,
    densify,
    drop_repeats,
    resample,
    signed_area_m2,
)
from infgen.sources.tfrecord import RecordError

MIN_CENTRE_POINTS = 10
MAX_AREA_CORNERS = 200_000
MAX_HEIGHTS = 20_000
"""Points that heights are taken from; of more every second, third, ... does."""
_LARGEST_ID = 2**62
_SIDES = {"left": Side.LEFT, "right": Side.RIGHT}
_LINKS = {"predecessors": LinkType.ENTRY, "successors": LinkType.EXIT}


@dataclass(frozen=True, slots=True)
class Ground:
    """Points of known height, for what lies on the road.

    Attributes:
        xyz_m: Points of lane boundaries and drivable areas, city frame.
    """

    xyz_m: Float64[np.ndarray, "point 3"]

    def height_m(
        self, xy_m: Float64[np.ndarray, "place 2"]
    ) -> Float64[np.ndarray, " place"]:
        """Height of the nearest known point; 0 where nothing is known."""
        if not len(self.xyz_m):
            return np.zeros(len(xy_m))
        found, size = np.empty(len(xy_m)), max(1, (1 << 20) // len(self.xyz_m))
        for first in range(0, len(xy_m), size):
            part_m = xy_m[first : first + size, None] - self.xyz_m[:, :2]
            nearest = (part_m**2).sum(axis=-1).argmin(axis=1)
            found[first : first + size] = self.xyz_m[nearest, 2]
        return found


@dataclass(frozen=True, slots=True)
class _Lane:
    """One lane segment.

    Attributes:
        id: Feature id.
        raw: As in the archive.
        centre_m: Centre line, in the direction of travel.
        bounds_m: Left and right boundary.
    """

    id: int
    raw: Mapping[str, Any]
    centre_m: Float64[np.ndarray, "_ 3"]
    bounds_m: Mapping[str, Float64[np.ndarray, "_ 3"]]


def read_map(data: bytes) -> tuple[MapBuilder, Ground]:
    """Read a map archive, city frame.

    Raises:
        RecordError: if it is no such archive, naming the part.
    """
    archive = _archive(data)
    lanes = [_lane(number, raw) for number, raw in _parts(archive, "lane_segments").items()]
    areas = [
        _points(raw, "area_boundary", f"drivable area {number}")
        for number, raw in _parts(archive, "drivable_areas").items()
    ]
    if sum(map(len, areas)) > MAX_AREA_CORNERS:
        raise RecordError(f"drivable areas have more than {MAX_AREA_CORNERS} corners")
    road_map = MapBuilder()
    used = {lane.id for lane in lanes}
    next_id = max(used, default=0) + 1
    _write_lanes(road_map, lanes, next_id)
    next_id += 2 * len(lanes)
    crossings = _parts(archive, "pedestrian_crossings")
    for at, (name, raw) in enumerate(crossings.items()):
        road_map.feature(next_id + at, FeatureType.CROSSWALK, 0, _crosswalk(name, raw))
    next_id += len(crossings)
    for at, edge_m in enumerate(road_edges(areas, [lane.centre_m for lane in lanes])):
        closed = len(edge_m) > 3 and bool((edge_m[0] == edge_m[-1]).all())
        island = closed and signed_area_m2(edge_m[:, :2]) < 0
        kind = RoadEdgeType.MEDIAN if island else RoadEdgeType.BOUNDARY
        road_map.feature(next_id + at, FeatureType.ROAD_EDGE, kind, edge_m)
    known = [bound_m for lane in lanes for bound_m in lane.bounds_m.values()]
    heights_m = np.concatenate([np.empty((0, 3)), *known, *areas])
    return road_map, Ground(heights_m[:: 1 + len(heights_m) // MAX_HEIGHTS])


def _archive(data: bytes) -> Mapping[str, Any]:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise RecordError(f"map archive is not JSON: {str(error)[:120]}") from error
    if not isinstance(found, dict) or "lane_segments" not in found:
        raise RecordError("map archive has no lane_segments")
    return found


def _parts(archive: Mapping[str, Any], name: str) -> dict[str, Mapping[str, Any]]:
    found = archive.get(name, {})
    if not isinstance(found, dict) or not all(isinstance(x, dict) for x in found.values()):
        raise RecordError(f"map archive: {name} is no dictionary of dictionaries")
    return found


def _points(raw: Mapping[str, Any], key: str, where: str) -> Float64[np.ndarray, "point 3"]:
    """Return a list of points; the height is 0 where it is not given."""
    found = raw.get(key)
    if not isinstance(found, list) or not found:
        raise RecordError(f"map archive: {where} has no {key}")
    try:
        rows = [(point["x"], point["y"], point.get("z", 0.0)) for point in found]
        points_m = np.array(rows, np.float64)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"map archive: {where} has no points in {key}") from error
    if not np.isfinite(points_m).all() or np.abs(points_m).max() > 1e8:
        raise RecordError(f"map archive: {where} has a point in {key} that is not finite")
    return points_m


def _lane(name: str, raw: Mapping[str, Any]) -> _Lane:
    """Read one lane; its centre line runs midway where the archive has none."""
    where = f"lane {name[:40]}"
    number = raw.get("id")
    if not isinstance(number, int) or not 0 <= number < _LARGEST_ID:
        raise RecordError(f"map archive: {where} has no id")
    bounds_m = {side: _points(raw, f"{side}_lane_boundary", where) for side in _SIDES}
    if any(arc_length_m(bound_m)[-1] == 0 for bound_m in bounds_m.values()):
        raise RecordError(f"map archive: {where} has a boundary of no length")
    longest_m = max(arc_length_m(bound_m)[-1] for bound_m in bounds_m.values())
    if longest_m > 1e5:
        raise RecordError(f"map archive: {where} is {longest_m:g} m long")
    count = max(MIN_CENTRE_POINTS, int(np.ceil(longest_m / SPACING_M)) + 1)
    middle_m = np.mean([resample(bound_m, count) for bound_m in bounds_m.values()], axis=0)
    if raw.get("centerline"):
        given_m = drop_repeats(_points(raw, "centerline", where))
        if arc_length_m(given_m)[-1] > 0:
            line_m = densify(given_m)
            share = arc_length_m(line_m) / arc_length_m(line_m)[-1]
            heights_m = np.interp(share, np.linspace(0, 1, count), middle_m[:, 2])
            return _Lane(number, raw, np.column_stack([line_m[:, :2], heights_m]), bounds_m)
    return _Lane(number, raw, drop_repeats(middle_m), bounds_m)


def _write_lanes(road_map: MapBuilder, lanes: list[_Lane], first_id: int) -> None:
    """Add lanes with their relations, and the painted lines between them."""
    by_id = {lane.id: lane for lane in lanes}
    if len(by_id) < len(lanes):
        raise RecordError("map archive: two lanes have one id")
    lines = _Lines(first_id)
    for lane in lanes:
        kind = LANE_TYPES.get(str(lane.raw.get("lane_type")), LaneType.UNDEFINED)
        inner = lane.raw.get("is_intersection") is True
        road_map.feature(
            lane.id, FeatureType.LANE, kind, lane.centre_m, interpolating=inner
        )
        for key, link in _LINKS.items():
            road_map.link(lane.id, link, _ids(lane.raw.get(key)))
        for word, side in _SIDES.items():
            for other in _ids([lane.raw.get(f"{word}_neighbor_id")]):
                _write_neighbour(road_map, lane, side, by_id.get(other))
        for word, side in _SIDES.items():
            mark = str(lane.raw.get(f"{word}_lane_mark_type", NO_MARK))
            if mark != NO_MARK:
                line, kind_of_line = lines.add(lane.bounds_m[word], mark)
                span = (0, len(lane.centre_m) - 1)
                road_map.boundary(lane.id, side, line, kind_of_line, span)
    lines.write(road_map)


def _write_neighbour(
    road_map: MapBuilder, lane: _Lane, side: Side, other: _Lane | None
) -> None:
    """Say what lies beside a lane, if it runs the same way: WOMD has no others."""
    if other is None:
        return
    own_m, its_m = (each.centre_m[-1] - each.centre_m[0] for each in (lane, other))
    if float(own_m[:2] @ its_m[:2]) > 0:
        own, its = (0, len(lane.centre_m) - 1), (0, len(other.centre_m) - 1)
        road_map.neighbour(lane.id, side, other.id, own, its)


class _Lines:
    """Painted lines; lanes on both sides of one share it."""

    def __init__(self, first_id: int) -> None:
        self._first_id = first_id
        self._known: dict[bytes, int] = {}
        self._lines: list[tuple[RoadLineType, np.ndarray]] = []

    def add(self, bound_m: Float64[np.ndarray, "point 3"], mark: str) -> tuple[int, int]:
        """Return id and type of the line along a boundary."""
        kind = MARK_TYPES.get(mark, RoadLineType.UNKNOWN)
        line_m = drop_repeats(bound_m)
        ways = (line_m.tobytes(), np.ascontiguousarray(line_m[::-1]).tobytes())
        row = next((self._known[way] for way in ways if way in self._known), None)
        if row is None:
            row = len(self._lines)
            self._known[ways[0]] = row
            self._lines.append((kind, densify(line_m)))
        return self._first_id + row, self._lines[row][0]

    def write(self, road_map: MapBuilder) -> None:
        """Add the lines to a map."""
        for row, (kind, line_m) in enumerate(self._lines):
            road_map.feature(self._first_id + row, FeatureType.ROAD_LINE, kind, line_m)


def _crosswalk(name: str, raw: Mapping[str, Any]) -> Float64[np.ndarray, "corner 3"]:
    """Outline of a crosswalk, from its two long sides."""
    one, two = (_points(raw, key, f"crossing {name[:40]}") for key in ("edge1", "edge2"))
    same_way = float((one[-1] - one[0])[:2] @ (two[-1] - two[0])[:2]) > 0
    return np.concatenate([one, two[::-1] if same_way else two])


def _ids(values: Any) -> list[int]:
    """Ids in a list; what is missing or no id is passed over."""
    found = values if isinstance(values, list) else []
    return [each for each in found if type(each) is int and 0 <= each < _LARGEST_ID]


def track_ids(names: list[str]) -> dict[str, int]:
    """Integer ids of tracks, by name."""
    return integer_ids(names, 2**31 - 1)
