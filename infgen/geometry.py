"""Poses, boxes and polylines. Pure array functions; batch dimensions come first.

A pose is [..., 3]: x and y in metres, heading in radians counter-clockwise from +x.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

SQUARES_PER_COLUMN = 1 << 20
"""Rows of squares in a column: more than any map needs."""
FEW_ANGLES = 512
"""So many remainders cost less than the calls that avoid them."""


def wrap_angle(angle_rad: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Bring angles to [-pi, pi)."""
    turn = angle_rad.dtype.type(2 * np.pi)
    half = angle_rad.dtype.type(np.pi)
    wrapped = _remainder(np.asarray(angle_rad + half), turn) - half
    # Rounding may lift an angle just below -pi to exactly +pi.
    return np.where(wrapped >= half, -half, wrapped)


def _remainder(
    angle_rad: Float[np.ndarray, "..."], turn: np.floating[Any]
) -> Float[np.ndarray, "..."]:
    """Return ``angle_rad % turn``, bit for bit, several times as fast for a turn or two.

    Within a turn of the range the remainder is one addition, which rounds as ``%`` does.
    For a few angles ``%`` alone is quickest.
    """
    if angle_rad.size < FEW_ANGLES:
        return np.asarray(angle_rad % turn)  # Of no axes, ``%`` makes a scalar.
    if not ((angle_rad >= -turn) & (angle_rad < 2 * turn)).all():
        return angle_rad % turn
    below = np.where(angle_rad < 0, angle_rad + turn, angle_rad)
    return np.where(angle_rad >= turn, angle_rad - turn, below)


def rotate(
    xy_m: Float[np.ndarray, "... 2"], angle_rad: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... 2"]:
    """Turn points counter-clockwise about the origin."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x_m, y_m = xy_m[..., 0], xy_m[..., 1]
    turned_x_m = cos * x_m - sin * y_m
    turned_m = np.empty((*turned_x_m.shape, 2), dtype=turned_x_m.dtype)
    turned_m[..., 0] = turned_x_m
    turned_m[..., 1] = sin * x_m + cos * y_m
    return turned_m


def to_local(
    pose: Float[np.ndarray, "... 3"], frame: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    """Express world poses in the frame of other poses. Inverse of ``to_world``."""
    xy_m = rotate(pose[..., :2] - frame[..., :2], -frame[..., 2])
    heading_rad = wrap_angle(pose[..., 2] - frame[..., 2])
    return np.concatenate([xy_m, heading_rad[..., None]], axis=-1)


def to_world(
    pose: Float[np.ndarray, "... 3"], frame: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    """Bring poses given in the frame of other poses to the world."""
    cos, sin = np.cos(frame[..., 2]), np.sin(frame[..., 2])
    x_m, y_m = pose[..., 0], pose[..., 1]
    placed_x_m = cos * x_m - sin * y_m + frame[..., 0]
    placed = np.empty((*placed_x_m.shape, 3), dtype=placed_x_m.dtype)
    placed[..., 0] = placed_x_m
    placed[..., 1] = sin * x_m + cos * y_m + frame[..., 1]
    placed[..., 2] = wrap_angle(pose[..., 2] + frame[..., 2])
    return placed


def box_corners(
    pose: Float[np.ndarray, "... 3"], size_lw_m: Float[np.ndarray, "... 2"]
) -> Float[np.ndarray, "... 4 2"]:
    """Corners [..., 4, 2] of boxes, counter-clockwise from front left."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=pose.dtype) / 2
    local_m = size_lw_m[..., None, :] * signs  # [..., corner, 2]
    turned_m = rotate(local_m, pose[..., None, 2])
    return turned_m + pose[..., None, :2]


def box_radius_m(
    size_lw_m: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch"]:
    """Radius of the circle around each box."""
    radius_m: np.ndarray = np.hypot(size_lw_m[..., 0], size_lw_m[..., 1]) / 2
    return radius_m


def boxes_overlap(
    pose: Float[np.ndarray, "... 3"],
    size_lw_m: Float[np.ndarray, "... 2"],
    other: Float[np.ndarray, "... 3"],
    other_size_lw_m: Float[np.ndarray, "... 2"],
) -> Bool[np.ndarray, "..."]:
    """Tell which boxes overlap; boxes that only touch do not.

    Two rectangles are apart if and only if an axis of one of them separates them.
    """
    away_m = other[..., :2] - pose[..., :2]
    turned_rad = other[..., 2] - pose[..., 2]
    turn = np.abs(np.cos(turned_rad)), np.abs(np.sin(turned_rad))
    return ~(
        _separates(rotate(away_m, -pose[..., 2]), size_lw_m, other_size_lw_m, turn)
        | _separates(rotate(away_m, -other[..., 2]), other_size_lw_m, size_lw_m, turn)
    )


def _separates(
    away_m: np.ndarray,
    size_lw_m: np.ndarray,
    other_size_lw_m: np.ndarray,
    turn: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Whether the other box lies wholly beyond an end or a side of the first.

    Args:
        away_m: From the one's centre to the other's, in the first one's frame; of any sign.
        size_lw_m: Of the first.
        other_size_lw_m: Of the other.
        turn: Cosine and sine of the angle between them, without their signs.
    """
    cos, sin = turn
    length_m, width_m = other_size_lw_m[..., 0] / 2, other_size_lw_m[..., 1] / 2
    ahead_m = cos * length_m + sin * width_m + size_lw_m[..., 0] / 2
    aside_m = sin * length_m + cos * width_m + size_lw_m[..., 1] / 2
    away_m = np.abs(away_m)
    apart: np.ndarray = (away_m[..., 0] >= ahead_m) | (away_m[..., 1] >= aside_m)
    return apart


def grid_squares(
    xy_m: Float[np.ndarray, "*shape 2"], side_m: float
) -> Int64[np.ndarray, "*shape"]:
    """Return the number of the grid square that each point lies in.

    Squares of a column are numbered consecutively, columns ``SQUARES_PER_COLUMN`` apart.
    """
    at = np.floor(xy_m / side_m).astype(np.int64)
    return at[..., 0] * SQUARES_PER_COLUMN + at[..., 1]
