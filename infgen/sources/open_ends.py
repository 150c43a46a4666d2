"""Where an outline of drivable area is the end of a map, and no edge of a road.

Maps are cut out around a drive. Where the cut goes through a road, the outline of the
drivable area goes straight across it, and a lane ends there or runs through.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

NEAR_M = 3.0
"""Parts of an outline within this distance of where a lane goes through it are no edge."""
AHEAD_M = 1.5
"""Lanes are made longer by this much at both ends before they are tried."""
MIN_SINE = 0.5
"""A lane goes through an outline at 30 degrees or more; others run along it."""
_BLOCK = 1 << 20
"""Pairs of lane parts and outline parts in memory at a time."""

Line = Float64[np.ndarray, "_ _"]


def at_open_ends(
    line_m: Line, judged: Bool[np.ndarray, " part"], lanes: Sequence[Line]
) -> Bool[np.ndarray, " part"]:
    """Tell which parts of an outline lie where a lane goes through it.

    Args:
        line_m: The outline; its parts lie between successive points.
        judged: Parts that lanes are tried against; others bound no area.
        lanes: Centre lines.
    """
    middle_m = (line_m[:-1, :2] + line_m[1:, :2]) / 2
    found = np.zeros(len(middle_m), bool)
    parts = [_longer(lane) for lane in lanes if len(lane) > 1]
    if not parts or not judged.any():
        return found
    start_m = np.concatenate([lane[:-1] for lane in parts])
    along_m = np.concatenate([np.diff(lane, axis=0) for lane in parts])
    rows = np.flatnonzero(judged)
    size = max(1, _BLOCK // len(start_m))
    crossings = [
        _crossings(line_m, rows[first : first + size], start_m, along_m)
        for first in range(0, len(rows), size)
    ]
    for place_m in np.concatenate(crossings):
        found |= ((middle_m - place_m) ** 2).sum(axis=1) < NEAR_M**2
    return found


def _crossings(
    line_m: Line, rows: np.ndarray, start_m: np.ndarray, along_m: np.ndarray
) -> Float64[np.ndarray, "crossing 2"]:
    """Places where parts of lanes go through parts of an outline."""
    side_m, sides_m = line_m[rows, :2], line_m[rows + 1, :2] - line_m[rows, :2]
    across = along_m[:, None, 0] * sides_m[:, 1] - along_m[:, None, 1] * sides_m[:, 0]
    gap_m = side_m - start_m[:, None]  # [lane part, side, 2]
    safe = np.where(across == 0, 1.0, across)
    share = (gap_m[..., 0] * sides_m[:, 1] - gap_m[..., 1] * sides_m[:, 0]) / safe
    along = (
        gap_m[..., 0] * along_m[:, None, 1] - gap_m[..., 1] * along_m[:, None, 0]
    ) / safe
    lengths_m2 = np.linalg.norm(along_m, axis=1)[:, None] * np.linalg.norm(sides_m, axis=1)
    hits = (np.abs(across) > MIN_SINE * lengths_m2) & (lengths_m2 > 0)
    hits &= (share >= 0) & (share <= 1) & (along >= 0) & (along <= 1)
    part, _ = np.nonzero(hits)
    return start_m[part] + share[hits][:, None] * along_m[part]


def _longer(lane: Line) -> Float64[np.ndarray, "point 2"]:
    """Make a line longer at both ends, straight on."""
    line_m = lane[:, :2]
    ends = []
    for end, before in ((line_m[0], line_m[1]), (line_m[-1], line_m[-2])):
        away_m = end - before
        ends.append(end + AHEAD_M * away_m / max(float(np.linalg.norm(away_m)), 1e-9))
    return np.concatenate([ends[:1], line_m, ends[1:]])
