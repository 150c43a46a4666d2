"""Where an outline of drivable area is the end of a map, and no edge of a road.

Maps are cut out around a drive. Where the cut goes through a road, the outline of the
drivable area goes straight across it, and a lane ends there or runs through.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

NEAR_M = 3.0
"""Parts of an outline within this distance of where a lane goes through it are no edge."""
AHEAD_M = 1.5
"""Lanes are made longer by this much at both ends before they are tried."""
MIN_SINE = 0.5
"""A lane goes through an outline at 30 degrees or more; others run along it."""
CELL_M = 4.0
"""Width of the cells by which parts that may cross are found: no part is longer."""

Line = Float64[np.ndarray, "_ _"]
_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
_COLUMN = 1 << 32
"""Cells in a column: more than any map has."""


class OpenEnds:
    """The lanes of a map, and where they go through outlines of its drivable area."""

    def __init__(self, lanes: Sequence[Line]) -> None:
        parts = [_longer(lane) for lane in lanes if len(lane) > 1]
        start_m = np.concatenate([np.empty((0, 2)), *(lane[:-1] for lane in parts)])
        along_m = np.concatenate(
            [np.empty((0, 2)), *(np.diff(lane, axis=0) for lane in parts)]
        )
        cell = _cells(start_m + along_m / 2)
        order = np.argsort(cell, kind="stable")
        self._cell, self._start_m, self._along_m = (
            values[order] for values in (cell, start_m, along_m)
        )

    def parts(
        self, line_m: Line, judged: Bool[np.ndarray, " part"]
    ) -> Bool[np.ndarray, " part"]:
        """Tell which parts of an outline lie where a lane goes through it.

        Args:
            line_m: The outline, its points no farther apart than 2 m.
            judged: Parts between successive points that lanes are tried against; the
                others bound no area.
        """
        middle_m = (line_m[:-1, :2] + line_m[1:, :2]) / 2
        found = np.zeros(len(middle_m), bool)
        for place_m in self._crossings(line_m, middle_m, np.flatnonzero(judged)):
            found |= ((middle_m - place_m) ** 2).sum(axis=1) < NEAR_M**2
        return found

    def _crossings(
        self, line_m: Line, middle_m: Line, rows: np.ndarray
    ) -> Float64[np.ndarray, "crossing 2"]:
        """Places where parts of lanes go through parts of an outline."""
        row, lane = self._near(middle_m, rows)
        start_m, along_m = self._start_m[lane], self._along_m[lane]
        sides_m = line_m[row + 1, :2] - line_m[row, :2]
        gap_m = line_m[row, :2] - start_m
        across = _cross(along_m, sides_m)
        safe = np.where(across == 0, 1.0, across)
        share, along = _cross(gap_m, sides_m) / safe, _cross(gap_m, along_m) / safe
        sizes_m2 = np.linalg.norm(along_m, axis=1) * np.linalg.norm(sides_m, axis=1)
        hits = (np.abs(across) > MIN_SINE * sizes_m2) & (sizes_m2 > 0)
        hits &= (share >= 0) & (share <= 1) & (along >= 0) & (along <= 1)
        return (start_m + share[:, None] * along_m)[hits]

    def _near(self, middle_m: Line, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of outline parts and lane parts in the same or neighbouring cells."""
        pairs = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
        for column, step in _NEIGHBOURS:
            cell = _cells(middle_m[rows]) + column * _COLUMN + step
            first = np.searchsorted(self._cell, cell, side="left")
            count = np.searchsorted(self._cell, cell, side="right") - first
            ends = np.cumsum(count)
            within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(
                ends - count, count
            )
            pairs.append((np.repeat(rows, count), np.repeat(first, count) + within))
        return (
            np.concatenate([row for row, _ in pairs]),
            np.concatenate([lane for _, lane in pairs]),
        )


def _cells(xy_m: Line) -> Int64[np.ndarray, " _"]:
    """Number the cells that points lie in."""
    place = np.floor(xy_m / CELL_M).astype(np.int64)
    return place[:, 0] * _COLUMN + place[:, 1]


def _cross(a_m: Line, b_m: Line) -> Float64[np.ndarray, " _"]:
    return a_m[:, 0] * b_m[:, 1] - a_m[:, 1] * b_m[:, 0]


def _longer(lane: Line) -> Line:
    """Make a line longer at both ends, straight on."""
    line_m = lane[:, :2]
    ends = []
    for end, before in ((line_m[0], line_m[1]), (line_m[-1], line_m[-2])):
        away_m = end - before
        ends.append(end + AHEAD_M * away_m / max(float(np.linalg.norm(away_m)), 1e-9))
    return np.concatenate([ends[:1], line_m, ends[1:]])
