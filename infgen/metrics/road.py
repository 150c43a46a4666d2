"""Distance of boxes to the nearest road edge, and whether they are off the road.

Edges have the road on their left. A corner of a box belongs to the edge segment nearest in
three dimensions, heights stretched so that bridges do not catch the cars below; the sign of
its distance is the side of that segment, or, past an end of it, of the corner with the next
segment. Definitions of the official metric, with one oddity: a closed edge counts as closed
only if no edge of the scene has more points.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from infgen.metrics.cells import nearest_by_cells
from infgen.metrics.motion import Motion

STRETCH_Z = np.float32(3.0)
"""Heights weigh this much more when the nearest segment is chosen."""
CLOSED_M2 = np.float32(1.0)
"""Squared distance of first and last point below which an edge is closed."""
NO_ROAD_M = np.float32(-1e10)
"""Distance of a box that is not there."""
NONE = -1


class RoadError(ValueError):
    """A map without what a road feature needs."""


@dataclass(frozen=True, slots=True)
class RoadEdges:
    """All segments of all road edges, edge by edge.

    Attributes:
        start_m: First point; heights stretched.
        along_m: From the first point to the last; heights stretched.
        before: Segment that leads to this one, or ``NONE``.
        after: Segment that this one leads to, or ``NONE``.
    """

    start_m: Float32[np.ndarray, "segment 3"]
    along_m: Float32[np.ndarray, "segment 3"]
    before: Int32[np.ndarray, " segment"]
    after: Int32[np.ndarray, " segment"]


def build_edges(polylines_m: Sequence[Float32[np.ndarray, "_ 3"]]) -> RoadEdges:
    """Cut road edges into segments. Edges of one point are left out.

    Raises:
        RoadError: if no edge is left: the official metric has no value without any.
    """
    lines_m = [line_m for line_m in polylines_m if len(line_m) >= 2]
    if not lines_m:
        raise RoadError("the map has no road edge of two or more points")
    longest = max(len(line_m) for line_m in lines_m)
    starts, alongs, neighbours, first = [], [], [], 0
    for line_m in lines_m:
        stretched_m = line_m * np.array([1, 1, STRETCH_Z], dtype=np.float32)
        starts.append(stretched_m[:-1])
        alongs.append(stretched_m[1:] - stretched_m[:-1])
        neighbours.append(_neighbours(line_m, first, closable=len(line_m) == longest))
        first += len(line_m) - 1
    return RoadEdges(
        start_m=np.concatenate(starts),
        along_m=np.concatenate(alongs),
        before=np.concatenate([before for before, _ in neighbours]),
        after=np.concatenate([after for _, after in neighbours]),
    )


def _neighbours(
    line_m: np.ndarray, first: int, *, closable: bool
) -> tuple[Int32[np.ndarray, " segment"], Int32[np.ndarray, " segment"]]:
    """Segments before and after each of one edge, whose first segment is ``first``."""
    rows = np.arange(first, first + len(line_m) - 1, dtype=np.int32)
    before, after = np.roll(rows, 1), np.roll(rows, -1)
    closed = closable and ((line_m[0] - line_m[-1]) ** 2).sum() < CLOSED_M2
    if not closed:
        before[0] = after[-1] = NONE
    return before, after


def road_edge_m(
    motion: Motion, evaluated: Int64[np.ndarray, " object"], steps: slice, edges: RoadEdges
) -> Float32[np.ndarray, "rollout object step"]:
    """Signed distance of each evaluated box's most off-road corner; positive is off-road.

    ``NO_ROAD_M`` where the box is not valid.
    """
    valid = motion.valid[:, evaluated, steps]
    corners_m = _bottom_corners_m(motion, evaluated, steps)[valid]  # [box, 4, 3]
    signed_m = signed_distance_m(corners_m.reshape(-1, 3), edges).reshape(-1, 4)
    found_m = np.full(valid.shape, NO_ROAD_M)
    found_m[valid] = signed_m.max(axis=1)
    return found_m


def signed_distance_m(
    points_m: Float32[np.ndarray, "point 3"], edges: RoadEdges
) -> Float32[np.ndarray, " point"]:
    """Distance in the plane to the edge segment nearest in space; positive on its right."""
    stretched_m = points_m * np.array([1, 1, STRETCH_Z], dtype=np.float32)
    nearest = nearest_by_cells(stretched_m, edges.start_m, edges.along_m)
    along_m = edges.along_m[nearest, :2]
    to_point_m = stretched_m[:, :2] - edges.start_m[nearest, :2]
    share = project(to_point_m, along_m)
    gap_m = to_point_m - along_m * np.clip(share, 0, 1)[:, None]
    side = np.sign(_cross(to_point_m, along_m))
    for past, neighbour in ((share < 0, edges.before), (share > 1, edges.after)):
        rows = np.flatnonzero(past & (neighbour[nearest] != NONE))
        own, other = nearest[rows], neighbour[nearest[rows]]
        to_other_m = stretched_m[rows, :2] - edges.start_m[other, :2]
        other_side = np.sign(_cross(to_other_m, edges.along_m[other, :2]))
        one, two = (other, own) if neighbour is edges.before else (own, other)
        convex = _cross(edges.along_m[one, :2], edges.along_m[two, :2]) > 0
        both = np.stack([side[rows], other_side])
        side[rows] = np.where(convex, both.max(axis=0), both.min(axis=0))
    return side * np.sqrt(_dot(gap_m, gap_m))


def project(
    to_point_m: Float32[np.ndarray, "... 2"], along_m: Float32[np.ndarray, "... 2"]
) -> Float32[np.ndarray, "..."]:
    """How far along a segment a point lies: 0 at its start, 1 at its end, not clipped."""
    length_m2 = _dot(along_m, along_m)
    share = _dot(to_point_m, along_m) / np.where(length_m2 > 0, length_m2, 1)
    return np.where(length_m2 > 0, share, np.float32(0))


def _bottom_corners_m(
    motion: Motion, evaluated: np.ndarray, steps: slice
) -> Float32[np.ndarray, "rollout object step 4 3"]:
    """Lower corners of the full boxes."""
    length_m, width_m, height_m = motion.size_lwh_m[evaluated].T[..., None, None] / 2
    ahead_m = length_m * np.array([1, -1, -1, 1], dtype=np.float32)
    aside_m = width_m * np.array([1, 1, -1, -1], dtype=np.float32)
    heading_rad = motion.heading_rad[:, evaluated, steps, None]
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    x_m = cos * ahead_m - sin * aside_m + motion.x_m[:, evaluated, steps, None]
    y_m = sin * ahead_m + cos * aside_m + motion.y_m[:, evaluated, steps, None]
    z_m = motion.z_m[:, evaluated, steps, None] - height_m
    return np.stack([x_m, y_m, np.broadcast_to(z_m, x_m.shape)], axis=-1)


def _dot(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    return a_m[..., 0] * b_m[..., 0] + a_m[..., 1] * b_m[..., 1]


def _cross(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    return a_m[..., 0] * b_m[..., 1] - a_m[..., 1] * b_m[..., 0]
