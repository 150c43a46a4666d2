"""Polylines and polygons of other data sets: made as dense as WOMD's, and looked into."""

import numpy as np
from jaxtyping import Bool, Float64

from infgen.sources.tfrecord import RecordError

SPACING_M = 1.0
"""Farthest that neighbouring points of a line may be apart. Map tokens end where a line
bends between points more than 3 m apart."""
MAX_LENGTH_M = 200_000.0
_BLOCK = 1 << 20
"""Pairs of points and polygon sides in memory at a time."""


def arc_length_m(xyz_m: Float64[np.ndarray, "point n"]) -> Float64[np.ndarray, " point"]:
    """Distance along a line of each of its points from the first, in the plane."""
    steps_m = np.linalg.norm(np.diff(xyz_m[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def resample(
    xyz_m: Float64[np.ndarray, "point n"], count: int
) -> Float64[np.ndarray, "count n"]:
    """Place so many points evenly along a line, both ends included."""
    arc_m = arc_length_m(xyz_m)
    wanted_m = np.linspace(0, arc_m[-1], count)
    columns = [np.interp(wanted_m, arc_m, column) for column in xyz_m.T]
    return np.stack(columns, axis=1)


def densify(
    xyz_m: Float64[np.ndarray, "point n"], spacing_m: float = SPACING_M
) -> Float64[np.ndarray, "dense n"]:
    """Add points to a line until neighbours are no farther apart; its own points stay.

    Example: 0 and 2.5 m become 0, 0.833, 1.667 and 2.5 m.

    Raises:
        RecordError: if the line is longer than any real one, or not finite.
    """
    if len(xyz_m) < 2:
        return xyz_m
    with np.errstate(over="ignore", invalid="ignore"):
        lengths_m = np.linalg.norm(np.diff(xyz_m[:, :2], axis=0), axis=1)
    if not lengths_m.sum() <= MAX_LENGTH_M:
        raise RecordError(f"a map line is {lengths_m.sum():g} m long")
    parts = np.maximum(1, np.ceil(lengths_m / spacing_m)).astype(np.int64)
    segment = np.repeat(np.arange(len(parts)), parts)
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    share = (within / parts[segment])[:, None]
    points_m = xyz_m[segment] * (1 - share) + xyz_m[segment + 1] * share
    return np.concatenate([points_m, xyz_m[-1:]])


def drop_repeats(xyz_m: Float64[np.ndarray, "point n"]) -> Float64[np.ndarray, "kept n"]:
    """Drop points that equal the one before."""
    if len(xyz_m) < 2:
        return xyz_m
    moved = (np.diff(xyz_m, axis=0) != 0).any(axis=1)
    return xyz_m[np.concatenate([[True], moved])]


def signed_area_m2(xy_m: Float64[np.ndarray, "corner 2"]) -> float:
    """Area of a polygon, closed or not; positive where corners run counter-clockwise."""
    x_m, y_m = (xy_m - xy_m[:1]).T
    return float((x_m * np.roll(y_m, -1) - np.roll(x_m, -1) * y_m).sum() / 2)


def inside(
    points_m: Float64[np.ndarray, "point 2"], corners_m: Float64[np.ndarray, "corner 2"]
) -> Bool[np.ndarray, " point"]:
    """Tell which points a polygon contains (even-odd rule), closed or not."""
    found = np.zeros(len(points_m), bool)
    low_m, high_m = corners_m.min(axis=0), corners_m.max(axis=0)
    near = np.flatnonzero(((points_m >= low_m) & (points_m <= high_m)).all(axis=1))
    start_m, end_m = corners_m, np.roll(corners_m, -1, axis=0)
    size = max(1, _BLOCK // len(corners_m))
    for first in range(0, len(near), size):
        rows = near[first : first + size]
        x_m, y_m = points_m[rows, :1], points_m[rows, 1:]
        spans = (start_m[:, 1] > y_m) != (end_m[:, 1] > y_m)  # [point, side]
        rise_m = np.where(end_m[:, 1] == start_m[:, 1], 1.0, end_m[:, 1] - start_m[:, 1])
        slope = (end_m[:, 0] - start_m[:, 0]) / rise_m
        crossing_m = start_m[:, 0] + (y_m - start_m[:, 1]) * slope
        found[rows] = (spans & (x_m < crossing_m)).sum(axis=1) % 2 == 1
    return found


def kept_chains(
    line_m: Float64[np.ndarray, "point n"], kept: Bool[np.ndarray, " part"]
) -> list[Float64[np.ndarray, "_ n"]]:
    """Join the kept parts of a line that follow one another, around its end if closed."""
    if kept.all():
        return [line_m]
    if not kept.any():
        return []
    if (line_m[0] == line_m[-1]).all():
        first = int(np.argmin(kept))  # Start where there is a gap.
        ring = np.roll(line_m[:-1], -first, axis=0)
        line_m, kept = np.concatenate([ring, ring[:1]]), np.roll(kept, -first)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], kept, [False]])))
    return [line_m[begin : end + 1] for begin, end in ends.reshape(-1, 2).tolist()]
