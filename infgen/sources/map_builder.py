"""A ``RoadMap`` from features one after the other, as sources other than WOMD give them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.scene import FeatureType, LinkType, RoadMap, Side
from infgen.sources.tfrecord import RecordError
from infgen.sources.womd_roads import check_road_map

MAX_POINTS = 4_000_000
"""More than any real map; a crafted file must not fill the memory."""
Span = tuple[int, int]
"""First and last point of a stretch of a line."""


@dataclass(slots=True)
class MapBuilder:
    """Features and their relations, in order; ``build`` makes a map of them."""

    _features: list[tuple[int, int, int, float, bool]] = field(default_factory=list)
    _points: list[np.ndarray] = field(default_factory=list)
    _links: list[tuple[int, int, int]] = field(default_factory=list)
    _neighbours: list[tuple[int, int, int, Span, Span]] = field(default_factory=list)
    _boundaries: list[tuple[int, int, int, int, Span, int]] = field(default_factory=list)
    _signs: list[tuple[int, int]] = field(default_factory=list)
    _num_points: int = 0

    def feature(
        self,
        feature_id: int,
        kind: FeatureType,
        subtype: int,
        xyz_m: Float64[np.ndarray, "point 3"],
        *,
        speed_mph: float = 0.0,
        interpolating: bool = False,
    ) -> None:
        """Add a feature, its points in the world frame.

        Raises:
            RecordError: if the map grows beyond any real one.
        """
        self._num_points += len(xyz_m)
        if self._num_points > MAX_POINTS:
            raise RecordError(f"map has more than {MAX_POINTS} points")
        self._features.append((feature_id, kind, subtype, speed_mph, interpolating))
        self._points.append(xyz_m)

    def link(self, lane: int, kind: LinkType, others: Iterable[int]) -> None:
        """Say which lanes lead to a lane, or which it leads to."""
        self._links += [(lane, kind, other) for other in others]

    def neighbour(self, lane: int, side: Side, other: int, own: Span, its: Span) -> int:
        """Say which lane lies beside a lane; return the row of the relation."""
        self._neighbours.append((lane, side, other, own, its))
        return len(self._neighbours) - 1

    def boundary(
        self, lane: int, side: Side, line: int, kind: int, span: Span, row: int = -1
    ) -> None:
        """Say which line bounds a lane, or parts it from the neighbour of a row."""
        self._boundaries.append((lane, side, line, kind, span, row))

    def sign(self, feature_id: int, lanes: Iterable[int]) -> None:
        """Say which lanes a stop sign controls."""
        self._signs += [(feature_id, lane) for lane in lanes]

    def lines_m(self, kind: FeatureType) -> list[Float64[np.ndarray, "_ 3"]]:
        """Points of the features of one kind so far."""
        pairs = zip(self._points, self._features, strict=True)
        return [points_m for points_m, (_, of, *_) in pairs if of == kind]

    def build(self, origin_xyz_m: Float64[np.ndarray, "3"]) -> RoadMap:
        """Make the map, in metres around an origin.

        Raises:
            RecordError: if a feature cannot be used, naming it.
        """
        ids, kinds, subtypes, speeds, interpolating = _columns(self._features, 5)
        lanes, links, others = _columns(self._links, 3)
        beside, sides, besides, own, its = _columns(self._neighbours, 5)
        bounded, bound_sides, lines, bound_kinds, spans, rows = _columns(
            self._boundaries, 6
        )
        signs, controlled = _columns(self._signs, 2)
        points_m = np.concatenate([np.empty((0, 3)), *self._points])
        lengths = [len(each) for each in self._points]
        with np.errstate(over="ignore", invalid="ignore"):
            local_m = (points_m - origin_xyz_m).astype(np.float32)
        try:
            road_map = RoadMap(
                feature_id=np.array(ids, np.int64),
                feature_type=np.array(kinds, np.int8),
                feature_subtype=np.array(subtypes, np.int8),
                speed_limit_mph=np.array(speeds, np.float32),
                interpolating=np.array(interpolating, bool),
                point_offsets=np.cumsum([0, *lengths], dtype=np.int64),
                xyz_m=local_m,
                link_lane_id=np.array(lanes, np.int64),
                link_type=np.array(links, np.int8),
                link_other_id=np.array(others, np.int64),
                neighbour_lane_id=np.array(beside, np.int64),
                neighbour_side=np.array(sides, np.int8),
                neighbour_other_id=np.array(besides, np.int64),
                neighbour_span=_spans(own, its),
                boundary_lane_id=np.array(bounded, np.int64),
                boundary_side=np.array(bound_sides, np.int8),
                boundary_feature_id=np.array(lines, np.int64),
                boundary_type=np.array(bound_kinds, np.int8),
                boundary_span=_spans(spans),
                boundary_neighbour=np.array(rows, np.int32),
                sign_id=np.array(signs, np.int64),
                sign_lane_id=np.array(controlled, np.int64),
            )
        except OverflowError as error:
            raise RecordError(f"map holds a number that is too large: {error}") from error
        check_road_map(road_map)
        return road_map


def _spans(*spans: Sequence[Span]) -> np.ndarray:
    columns = [np.array(part, np.int32).reshape(-1, 2) for part in spans]
    return np.concatenate(columns, axis=1)


def _columns(rows: Sequence[tuple[Any, ...]], width: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) if rows else [()] * width
