"""Map features of a ScenarioNet description."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.scene import (
    FeatureType,
    LaneType,
    LinkType,
    RoadEdgeType,
    RoadLineType,
    RoadMap,
    Side,
)
from infgen.sources.ids import integer_ids, integer_name
from infgen.sources.map_builder import MapBuilder, Span
from infgen.sources.polylines import densify, drop_repeats
from infgen.sources.scenarionet.datasets import Convention
from infgen.sources.scenarionet.outlines import Outlines
from infgen.sources.scenarionet.parts import (
    Part,
    integer_of,
    number_of,
    points_of,
    sequence_of,
    text_of,
)

MPH_PER_KMH = 1 / 1.609344
SPAN = (
    "self_start_index",
    "self_end_index",
    "neighbor_start_index",
    "neighbor_end_index",
)
"""Keys of the stretches along which a lane and its neighbour lie side by side."""
SIDES = {"left": Side.LEFT, "right": Side.RIGHT}
LINKS = {"entry_lanes": LinkType.ENTRY, "exit_lanes": LinkType.EXIT}
BOUNDARY = "boundary_"
"""First letters of the names of outlines of the drivable area."""

_LARGEST_ID = 2**63 - 1
_LANES = {
    "LANE_FREEWAY": LaneType.FREEWAY,
    "LANE_SURFACE_STREET": LaneType.SURFACE_STREET,
    "LANE_SURFACE_UNSTRUCTURE": LaneType.SURFACE_STREET,
    "LANE_BIKE_LANE": LaneType.BIKE_LANE,
    "LANE_UNKNOWN": LaneType.UNDEFINED,
}
_EDGES = {
    "ROAD_EDGE_BOUNDARY": RoadEdgeType.BOUNDARY,
    "ROAD_EDGE_MEDIAN": RoadEdgeType.MEDIAN,
    "ROAD_EDGE_SIDEWALK": RoadEdgeType.BOUNDARY,
    "BOUNDARY_LINE": RoadEdgeType.BOUNDARY,
    "UNKNOWN": RoadEdgeType.UNKNOWN,
}
LINE_TYPES = {
    "UNKNOWN_LINE": RoadLineType.UNKNOWN,
    "UNKNOWN": RoadLineType.UNKNOWN,
    **{f"ROAD_LINE_{kind.name}": kind for kind in RoadLineType},
}
_AREAS = {
    "CROSSWALK": FeatureType.CROSSWALK,
    "SPEED_BUMP": FeatureType.SPEED_BUMP,
    "DRIVEWAY": FeatureType.DRIVEWAY,
}


def lane_ids(features: Mapping[str, Part]) -> dict[str, int]:
    """Integer ids of map features, by name."""
    return integer_ids(features, _LARGEST_ID)


def read_road_map(
    features: Mapping[str, Part],
    ids: Mapping[str, int],
    convention: Convention,
    origin_xyz_m: Float64[np.ndarray, "3"],
) -> RoadMap:
    """Read all features of types that WOMD has too; others are passed over.

    Raises:
        RecordError: if a feature cannot be used, naming it.
    """
    reader = _Reader(ids, convention)
    for name, feature in features.items():
        reader.take(name, feature)
    reader.outlines.write(reader.map, max(ids.values(), default=0) + 1)
    return reader.map.build(origin_xyz_m)


class _Reader:
    """Features on their way into a map."""

    def __init__(self, ids: Mapping[str, int], convention: Convention) -> None:
        self.map = MapBuilder()
        self.outlines = Outlines()
        self._ids, self._convention = ids, convention

    def take(self, name: str, feature: Part) -> None:
        """Read one feature."""
        kind, number = text_of(feature.get("type")), self._ids[name]
        if self._convention.boundary_is_edge and name.startswith(BOUNDARY):
            self.outlines.add(self._points(feature, "polyline", name))
        elif kind in _LANES:
            self._lane(name, feature, _LANES[kind])
        elif kind in _EDGES:
            self._line(name, feature, FeatureType.ROAD_EDGE, _EDGES[kind])
        elif kind in LINE_TYPES:
            self._line(name, feature, FeatureType.ROAD_LINE, LINE_TYPES[kind])
        elif kind == "STOP_SIGN":
            points_m = self._points(feature, "position", name)
            self.map.feature(number, FeatureType.STOP_SIGN, 0, points_m[:1])
            self.map.sign(number, self._named(feature.get("lane")))
        elif kind in _AREAS:
            points_m = self._points(feature, "polygon", name)
            self.map.feature(number, _AREAS[kind], 0, points_m)

    def _points(self, feature: Part, key: str, name: str) -> Float64[np.ndarray, "point 3"]:
        found = points_of(feature.get(key), f"feature {name[:40]}")
        if not self._convention.heights:
            found = found[:, :2]
        return np.pad(found[:, :3], ((0, 0), (0, max(0, 3 - found.shape[1]))))

    def _polyline(self, feature: Part, name: str) -> Float64[np.ndarray, "point 3"] | None:
        """Points of a line; None where it is no line and the data set is not WOMD's."""
        points_m = self._points(feature, "polyline", name)
        if self._convention.dense:
            return points_m
        points_m = drop_repeats(points_m)
        return densify(points_m) if len(points_m) > 1 else None

    def _line(self, name: str, feature: Part, kind: FeatureType, subtype: int) -> None:
        points_m = self._polyline(feature, name)
        if points_m is not None:
            self.map.feature(self._ids[name], kind, subtype, points_m)

    def _lane(self, name: str, feature: Part, subtype: LaneType) -> None:
        points_m = self._polyline(feature, name)
        if points_m is None:
            return
        lane, last = self._ids[name], len(points_m) - 1
        self.map.feature(
            lane,
            FeatureType.LANE,
            subtype,
            points_m,
            speed_mph=self._speed_mph(feature),
            interpolating=feature.get("interpolating") is True,
        )
        for key, link in LINKS.items():
            self.map.link(lane, link, self._named(feature.get(key)))
        for word, side in SIDES.items():
            for each in sequence_of(feature.get(f"{word}_neighbor")):
                self._neighbour(lane, side, each, last)
        for word, side in SIDES.items():
            for each in sequence_of(feature.get(f"{word}_boundaries")):
                self._boundary(lane, side, each, -1)

    def _speed_mph(self, feature: Part) -> float:
        if not self._convention.speed_limits:
            return 0.0
        mph = number_of(feature.get("speed_limit_mph"))
        return mph or number_of(feature.get("speed_limit_kmh")) * MPH_PER_KMH

    def _neighbour(self, lane: int, side: Side, each: Any, last: int) -> None:
        if not isinstance(each, dict):  # NuPlan names lanes only.
            for other in self._named([each]):
                self.map.neighbour(lane, side, other, (0, last), (0, 0))
            return
        own_first, own_last, its_first, its_last = (_index(each.get(key)) for key in SPAN)
        for other in self._named([each.get("feature_id")]):
            own, its = (own_first, own_last), (its_first, its_last)
            row = self.map.neighbour(lane, side, other, own, its)
            for bound in sequence_of(each.get("boundaries")):
                self._boundary(lane, side, bound, row)

    def _boundary(self, lane: int, side: Side, each: Any, row: int) -> None:
        if not isinstance(each, dict):
            return
        kind = LINE_TYPES.get(text_of(each.get("boundary_type")), RoadLineType.UNKNOWN)
        span: Span = (
            _index(each.get("lane_start_index")),
            _index(each.get("lane_end_index")),
        )
        for line in self._named([each.get("boundary_feature_id")]):
            self.map.boundary(lane, side, line, kind, span, row)

    def _named(self, names: Any) -> list[int]:
        """Ids of features by name; ids that are not in the map may stand for themselves."""
        found = []
        for name in sequence_of(names):
            word = str(name) if isinstance(name, str | int) else ""
            if word in self._ids:
                found.append(self._ids[word])
            elif (number := integer_name(name)) is not None:
                found.append(number)
        return found


def _index(value: Any) -> int:
    return min(integer_of(value), 2**31 - 1)
