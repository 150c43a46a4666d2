"""The lane segments near a point, without looking at all lanes of a map."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

SIDE_M = 10.0
"""Least side of a square."""
MARGIN_M = 0.1
"""Squares list segments a little farther away than asked for: rounding loses none."""

Lanes = tuple[Float32[np.ndarray, "_ 2"], Float32[np.ndarray, "_ 2"]]
"""First point of each segment, and the vector to its last point."""


@dataclass(frozen=True, slots=True)
class LaneSquares:
    """For each square of some maps the lane segments within a distance of it.

    Attributes:
        corner_m: Corner of each map's first square.
        side_m: Side of a square.
        size: Squares along x and y: of the largest map.
        begin: Where the segments of each square begin; the squares of one map after those
            of the other, then the number of all.
        start_m: First point of the segments, by square.
        along_m: Vector from there to their last point.
        reach_m: The distance.
        is_sure: Squares that are within it of a segment as a whole.
    """

    corner_m: Float32[np.ndarray, "scene 2"]
    side_m: float
    size: tuple[int, int]
    begin: Int64[np.ndarray, " bound"]
    start_m: Float32[np.ndarray, "listed 2"]
    along_m: Float32[np.ndarray, "listed 2"]
    reach_m: float
    is_sure: Bool[np.ndarray, " square"]

    @classmethod
    def of(cls, maps: Sequence[Lanes], reach_m: float) -> "LaneSquares":
        """List the lanes of maps by square."""
        side_m, wide_m = max(SIDE_M, reach_m / 2), reach_m + MARGIN_M
        boxes = [_bounds_m(lanes, wide_m) for lanes in maps]
        corner_m = np.zeros((len(maps), 2), dtype=np.float32)
        for at, (low_m, _) in enumerate(boxes):
            corner_m[at] = low_m.min(axis=0, initial=np.inf) if len(low_m) else 0
        spans = [
            ((low_m - at_m) // side_m, (high_m - at_m) // side_m)
            for (low_m, high_m), at_m in zip(boxes, corner_m, strict=True)
        ]
        lasts = np.concatenate([last for _, last in spans])
        columns, rows = (1 + lasts.max(axis=0, initial=0)).astype(int).tolist()
        found = [
            _listed(first.astype(np.int64), last.astype(np.int64), columns)
            for first, last in spans
        ]
        square = np.concatenate(
            [at * columns * rows + own for at, (own, _) in enumerate(found)]
        )
        begin = np.searchsorted(square, np.arange(len(maps) * columns * rows + 1))
        start_m, along_m = (
            np.concatenate(
                [lanes[k][own] for lanes, (_, own) in zip(maps, found, strict=True)]
            )
            for k in (0, 1)
        )
        size, is_sure = (columns, rows), np.zeros(len(begin) - 1, dtype=bool)
        within = _are_within(corner_m, side_m, size, square, (start_m, along_m), reach_m)
        is_sure[square[within]] = True
        return cls(corner_m, side_m, size, begin, start_m, along_m, reach_m, is_sure)

    def has_lane(
        self, xy_m: Float32[np.ndarray, "point 2"], scene: Int64[np.ndarray, " point"]
    ) -> Bool[np.ndarray, " point"]:
        """Tell which points have a lane of their map within the distance."""
        columns, rows = self.size
        at = np.floor((xy_m - self.corner_m[scene]) / self.side_m).clip(-1, max(self.size))
        column, row = at.astype(np.int64).T
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        square = np.where(inside, (scene * rows + row) * columns + column, 0)
        found = self.is_sure[square] & inside
        first = self.begin[square]
        count = (self.begin[square + 1] - first) * (inside & ~found)
        if not count.any():
            return found
        point = np.repeat(np.arange(len(xy_m)), count)
        listed = np.arange(len(point)) + np.repeat(first - (count.cumsum() - count), count)
        gap_m = lane_gap_m(xy_m[point], self.start_m[listed], self.along_m[listed])
        found[point[gap_m <= self.reach_m]] = True
        return found


def _are_within(
    corner_m: Float32[np.ndarray, "scene 2"],
    side_m: float,
    size: tuple[int, int],
    square: Int64[np.ndarray, " listed"],
    segments: Lanes,
    reach_m: float,
) -> Bool[np.ndarray, " listed"]:
    """Tell which squares are within a distance of a segment that they list, as a whole.

    The distance to a segment is convex: nowhere in a square is it larger than at a corner.
    """
    columns, rows = size
    scene, own = np.divmod(square, columns * rows)
    at = np.stack([own % columns, own // columns], axis=-1)
    within = np.ones(len(square), dtype=bool)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corners_m = (corner_m[scene] + (at + corner) * side_m).astype(np.float32)
        within &= lane_gap_m(corners_m, *segments) < reach_m - MARGIN_M
    return within


def lane_gap_m(
    xy_m: Float32[np.ndarray, "*#shape 2"],
    start_m: Float32[np.ndarray, "*#shape 2"],
    along_m: Float32[np.ndarray, "*#shape 2"],
) -> Float32[np.ndarray, "*shape"]:
    """Distance of points to segments."""
    # One axis at a time: sums over a last dimension of two are slow.
    along_x_m, along_y_m = along_m[..., 0], along_m[..., 1]
    x_m, y_m = xy_m[..., 0] - start_m[..., 0], xy_m[..., 1] - start_m[..., 1]
    length2 = np.maximum(along_x_m**2 + along_y_m**2, np.float32(1e-6))
    share = np.clip((x_m * along_x_m + y_m * along_y_m) / length2, 0, 1)
    x_m, y_m = x_m - share * along_x_m, y_m - share * along_y_m
    return np.sqrt(x_m * x_m + y_m * y_m)


def _bounds_m(lanes: Lanes, wide_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Opposite corners of the boxes that hold all points within a distance of segments."""
    start_m, along_m = lanes
    end_m = start_m + along_m
    return np.minimum(start_m, end_m) - wide_m, np.maximum(start_m, end_m) + wide_m


def _listed(
    first: Int64[np.ndarray, "lane 2"], last: Int64[np.ndarray, "lane 2"], columns: int
) -> tuple[Int64[np.ndarray, " listed"], Int64[np.ndarray, " listed"]]:
    """Squares from a first to a last one, in order, and the segment that each lists."""
    wide, high = (last - first + 1).T
    count = wide * high
    segment = np.repeat(np.arange(len(first)), count)
    step = np.arange(len(segment)) - np.repeat(count.cumsum() - count, count)
    column = first[segment, 0] + step % wide[segment]
    row = first[segment, 1] + step // wide[segment]
    square = row * columns + column
    order = np.argsort(square, kind="stable")
    return square[order], segment[order]
