"""Exact nearest segment of many points, by a coarse-to-fine search over cells.

Points are gathered in cells, coarse then fine. From the middle of a cell to one of its
points the distance to a segment changes by no more than the way there, times a little where
the segment is steep. That tells which segments can be nearest to some point of a cell; only
they are handed down, and tried for each point at the end.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

CELL_WIDTHS_M = (24.0, 4.0)
"""Width of a cell, coarse to fine."""
SLACK_M = 0.05
"""Added to every bound, so that float32 rounding cannot prune the nearest."""
PAIRS_PER_BLOCK = 1 << 16


class Candidates(NamedTuple):
    """Segments that may be the nearest, per group: ``segment[start[g] : start[g + 1]]``."""

    start: Int64[np.ndarray, " group+1"]
    segment: Int64[np.ndarray, " candidate"]


def nearest_by_cells(
    points_m: Float32[np.ndarray, "point 3"],
    start_m: Float32[np.ndarray, "segment 3"],
    along_m: Float32[np.ndarray, "segment 3"],
) -> Int64[np.ndarray, " point"]:
    """Row of the segment nearest to each point; the first of equals.

    The place on a segment is found in the plane, the distance to it in space.
    """
    segments = np.ascontiguousarray(np.concatenate([start_m, along_m], axis=1).T)
    change = _distance_slope(along_m)
    known = Candidates(np.array([0, len(start_m)]), np.arange(len(start_m)))
    group = np.zeros(len(points_m), dtype=np.int64)
    for width_m in CELL_WIDTHS_M:
        parent, group = group, _cells(points_m, width_m, group)
        middle_m, radius_m, above = _bounds(points_m, group, parent)
        known = _prune(middle_m, radius_m, above, known, segments, change)
    return _first_nearest(points_m, group, known, segments)


def _cells(points_m: np.ndarray, width_m: float, parent: np.ndarray) -> np.ndarray:
    """Number the cells that hold points; a cell lies within one parent."""
    place = np.floor(points_m[:, :2] / np.float32(width_m)).astype(np.int64)
    place -= place.min(axis=0, initial=0)
    spread = place.max(axis=0, initial=0) + 1
    key = (parent * spread[0] + place[:, 0]) * spread[1] + place[:, 1]
    return np.unique(key, return_inverse=True)[1].reshape(-1)


def _bounds(
    points_m: np.ndarray, group: np.ndarray, parent: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle and radius of each group's box of points, and its parent group."""
    order = np.argsort(group, kind="stable")
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    low_m = np.minimum.reduceat(points_m[order], first) if len(first) else points_m
    high_m = np.maximum.reduceat(points_m[order], first) if len(first) else points_m
    middle_m = (low_m + high_m) / 2
    radius_m = np.sqrt(((high_m - low_m) ** 2).sum(axis=1)) / 2
    return middle_m, radius_m, parent[order][first]


def _distance_slope(along_m: np.ndarray) -> Float32[np.ndarray, " segment"]:
    """By how much the distance to a segment changes at most, per metre that one goes.

    The place on it is found in the plane: it moves up and down with its slope, beside the
    point itself. That is the norm of [[1, 0], [slope, 1]].
    """
    flat_m = np.hypot(along_m[:, 0], along_m[:, 1])
    slope = np.abs(along_m[:, 2]) / np.where(flat_m > 0, flat_m, np.inf)
    return (slope + np.sqrt(slope * slope + 4)) / 2


def _prune(
    middle_m: np.ndarray,
    radius_m: np.ndarray,
    parent: np.ndarray,
    known: Candidates,
    segments: np.ndarray,
    change: np.ndarray,
) -> Candidates:
    """Keep the segments that may be nearest to some point within reach of a middle."""
    counts, kept = [], []
    for some in _blocks(np.diff(known.start)[parent]):
        start, segment = _expand(known, parent[some])
        point = np.repeat(np.arange(some.start, some.stop), np.diff(start))
        gap_m = _distance_m(middle_m[point].T, segment, segments)
        stray_m = change[segment] * radius_m[point]
        at_most_m = np.minimum.reduceat(gap_m + stray_m, start[:-1]) + SLACK_M
        keep = gap_m - stray_m <= np.repeat(at_most_m, np.diff(start))
        kept.append(segment[keep])
        counts.append(np.add.reduceat(keep, start[:-1], dtype=np.int64))
    none = np.zeros(0, dtype=np.int64)
    ends = np.cumsum(np.concatenate([none, *counts]))
    return Candidates(np.concatenate([[0], ends]), np.concatenate([none, *kept]))


def _first_nearest(
    points_m: np.ndarray, group: np.ndarray, known: Candidates, segments: np.ndarray
) -> Int64[np.ndarray, " point"]:
    found = np.zeros(len(points_m), dtype=np.int64)
    for some in _blocks(np.diff(known.start)[group]):
        start, segment = _expand(known, group[some])
        point = np.repeat(np.arange(some.start, some.stop), np.diff(start))
        gap_m = _distance_m(points_m[point].T, segment, segments)
        least_m = np.minimum.reduceat(gap_m, start[:-1])
        hit = np.flatnonzero(gap_m == np.repeat(least_m, np.diff(start)))
        first = np.diff(point[hit], prepend=-1) != 0
        found[some] = segment[hit[first]]
    return found


def _expand(known: Candidates, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lay the candidates of some groups end to end: where each starts, and their rows."""
    sizes = np.diff(known.start)[groups]
    start = np.concatenate([[0], np.cumsum(sizes)])
    row = np.arange(start[-1]) + np.repeat(known.start[groups] - start[:-1], sizes)
    return start, known.segment[row]


def _blocks(sizes: np.ndarray) -> list[slice]:
    """Cut a list of groups into runs of about ``PAIRS_PER_BLOCK`` pairs."""
    block = np.cumsum(sizes) // PAIRS_PER_BLOCK
    cuts = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(sizes)]
    return [slice(a, b) for a, b in pairwise(cuts) if b > a]


def _distance_m(
    point_m: np.ndarray, segment: np.ndarray, segments: np.ndarray
) -> Float32[np.ndarray, " pair"]:
    """Distance in space of points [3, pair] to segments, by rows."""
    start_x, start_y, start_z, along_x, along_y, along_z = segments[:, segment]
    x, y, z = point_m[0] - start_x, point_m[1] - start_y, point_m[2] - start_z
    length_m2 = along_x * along_x + along_y * along_y
    share = (x * along_x + y * along_y) / np.where(length_m2 > 0, length_m2, 1)
    share = np.clip(share, 0, 1)
    x, y, z = x - along_x * share, y - along_y * share, z - along_z * share
    return np.sqrt(x * x + y * y + z * z)
