"""Curves in the plane: points [point, 2] in metres, from start to end."""

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "_ 2"]

MOST_HANDLE = 2 / 3
"""Longest handle of a curve as a share of the way to the corner, as of an arc."""
_PARALLEL = 0.01


def arc_lengths(xy_m: Points) -> Float64[np.ndarray, " point"]:
    """Distance of every point from the first, along the curve."""
    steps_m = np.linalg.norm(np.diff(xy_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def length(xy_m: Points) -> float:
    """Length of a curve."""
    return float(arc_lengths(xy_m)[-1])


def points_at(
    xy_m: Points, along_m: Float64[np.ndarray, " at"]
) -> Float64[np.ndarray, "at 2"]:
    """Points at distances along a curve; its ends beyond them."""
    known_m = arc_lengths(xy_m)
    return np.column_stack([np.interp(along_m, known_m, xy_m[:, axis]) for axis in (0, 1)])


def resample(xy_m: Points, spacing_m: float) -> Points:
    """Space the points of a curve evenly, as near to the spacing as its length allows."""
    total_m = length(xy_m)
    count = max(1, round(total_m / spacing_m))
    return points_at(xy_m, np.linspace(0.0, total_m, count + 1))


def headings(xy_m: Points) -> Float64[np.ndarray, " point"]:
    """Direction at every point, in radians, without jumps of a whole turn."""
    tangent = np.gradient(xy_m, axis=0)
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def offset(xy_m: Points, left_m: float) -> Points:
    """Shift a curve to its left."""
    heading_rad = headings(xy_m)
    normal = np.column_stack([-np.sin(heading_rad), np.cos(heading_rad)])
    return xy_m + left_m * normal


def start_pose(xy_m: Points) -> Float64[np.ndarray, "3"]:
    """Pose at the start of a curve, heading along it."""
    return np.array([*xy_m[0], headings(xy_m[:2])[0]])


def end_pose(xy_m: Points) -> Float64[np.ndarray, "3"]:
    """Pose at the end of a curve, heading along it."""
    return np.array([*xy_m[-1], headings(xy_m[-2:])[0]])


def join(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"], spacing_m: float
) -> Points:
    """Join two poses smoothly: nearly an arc where an arc would do (a cubic Bézier).

    Where one end is nearer to the corner than the other, the curve stays on its side.
    """
    chord_m = float(np.linalg.norm(end[:2] - start[:2]))
    turn_rad = abs((end[2] - start[2] + np.pi) % (2 * np.pi) - np.pi)
    # The handles with which a Bézier follows an arc of this chord and turn.
    arc = (
        4 / 3 * np.tan(turn_rad / 4) / (2 * np.sin(turn_rad / 2))
        if turn_rad > 0.01
        else 1 / 3
    )
    out_m, in_m = (
        min(chord_m * arc, MOST_HANDLE * corner_m)
        * np.array([np.cos(pose[2]), np.sin(pose[2])])
        for pose, corner_m in zip((start, end), _to_corner(start, end), strict=True)
    )
    corners_m = [start[:2], start[:2] + out_m, end[:2] - in_m, end[:2]]
    part = np.linspace(0.0, 1.0, 65)[:, None]
    weights = [
        (1 - part) ** 3,
        3 * part * (1 - part) ** 2,
        3 * part**2 * (1 - part),
        part**3,
    ]
    fine_m = sum(weight * corner for weight, corner in zip(weights, corners_m, strict=True))
    return resample(np.asarray(fine_m), spacing_m)


def _to_corner(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]
) -> tuple[float, float]:
    """Distances to where two straight lines meet that go on from, and back from, two poses.

    Both infinite where they do not.
    """
    (out_x, out_y), (in_x, in_y) = ((np.cos(at[2]), np.sin(at[2])) for at in (start, end))
    x_m, y_m = end[:2] - start[:2]
    sine = out_x * in_y - out_y * in_x
    if abs(sine) < _PARALLEL:
        return np.inf, np.inf
    ahead_m = (x_m * in_y - y_m * in_x) / sine
    behind_m = (out_x * y_m - out_y * x_m) / sine
    return (ahead_m, behind_m) if min(ahead_m, behind_m) > 0 else (np.inf, np.inf)


def chain(*parts: Points) -> Points:
    """Lay curves end to end; a point where one ends and the next starts stands once."""
    kept = [parts[0]]
    for part in parts[1:]:
        touches = np.linalg.norm(part[0] - kept[-1][-1]) < 1e-6
        kept.append(part[1:] if touches else part)
    return np.concatenate(kept)
