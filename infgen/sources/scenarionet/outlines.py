"""Outlines of the drivable area as road edges, with the road on their left."""

import numpy as np
from jaxtyping import Float64

from infgen.scene import FeatureType, RoadEdgeType
from infgen.sources.map_builder import MapBuilder
from infgen.sources.open_ends import OpenEnds
from infgen.sources.polylines import (
    densify,
    drop_repeats,
    inside,
    kept_chains,
    signed_area_m2,
)

MARGIN_M = 30.0
"""Outlines are those of a whole town: they are kept this far around the other features."""
CLOSED_GAP_M = 0.01


class Outlines:
    """Closed and open outlines of a drivable area, in no particular direction.

    The area lies within an outer ring and outside the rings in it, which are islands. Rings
    are turned so that it is on their left: outer ones counter-clockwise, islands clockwise.
    Open outlines, cut off at the end of a map, stay as they are.
    """

    def __init__(self) -> None:
        self._lines: list[Float64[np.ndarray, "point 3"]] = []

    def add(self, xyz_m: Float64[np.ndarray, "point 3"]) -> None:
        """Take one outline."""
        line_m = drop_repeats(xyz_m)
        if len(line_m) > 1:
            self._lines.append(line_m)

    def write(self, road_map: MapBuilder, first_id: int) -> None:
        """Add the outlines near the lanes of a map to it, numbered from an id.

        Where a lane goes through an outline, the map ends and not the road.
        """
        lanes = road_map.lines_m(FeatureType.LANE)
        ends = OpenEnds(lanes)
        points_m = np.concatenate([np.zeros((1, 3)) if not lanes else lanes[0], *lanes])
        low_m, high_m = points_m[:, :2].min(axis=0), points_m[:, :2].max(axis=0)
        for depth, line_m in zip(self._depths(), self._lines, strict=True):
            ring_m = densify(_turned(line_m, depth))
            kind = RoadEdgeType.MEDIAN if depth % 2 else RoadEdgeType.BOUNDARY
            middle_m = (ring_m[:-1, :2] + ring_m[1:, :2]) / 2
            near = (middle_m >= low_m - MARGIN_M) & (middle_m <= high_m + MARGIN_M)
            kept = near.all(axis=1)
            kept &= ~ends.parts(ring_m, kept)
            for part_m in kept_chains(ring_m, kept):
                road_map.feature(first_id, FeatureType.ROAD_EDGE, kind, part_m)
                first_id += 1

    def _depths(self) -> list[int]:
        """In how many other rings each ring lies."""
        rings = [line_m if _is_closed(line_m) else None for line_m in self._lines]
        first_m = np.array([line_m[0, :2] for line_m in self._lines]).reshape(-1, 2)
        depth = np.zeros(len(rings), np.int64)
        for row, ring_m in enumerate(rings):
            if ring_m is not None:
                within = inside(first_m, ring_m[:, :2])
                within[row] = False
                depth += within
        return depth.tolist()


def _is_closed(line_m: Float64[np.ndarray, "point 3"]) -> bool:
    return len(line_m) > 3 and bool(np.abs(line_m[0] - line_m[-1]).max() < CLOSED_GAP_M)


def _turned(
    line_m: Float64[np.ndarray, "point 3"], depth: int
) -> Float64[np.ndarray, "point 3"]:
    clockwise = signed_area_m2(line_m[:, :2]) < 0
    turn = _is_closed(line_m) and clockwise == (depth % 2 == 0)
    return line_m[::-1] if turn else line_m
