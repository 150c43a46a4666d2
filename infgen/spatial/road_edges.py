"""Distance of points to the nearest road edge, and on which side of it they are.

Edges have the road on their left. A point belongs to the edge segment nearest in three
dimensions, heights stretched so that bridges do not catch the cars below; the sign of its
distance is the side of that segment, or, past an end of it, of the corner with the next
segment. Definitions of the official metric, with one oddity: a closed edge counts as closed
only if no edge of the scene has more points.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32

from infgen.scene import FeatureType, Scene
from infgen.spatial.nearest import nearest_by_cells

HEIGHT_SCALE = np.float32(3.0)
"""Factor on heights when the nearest segment is chosen."""
CLOSED_GAP_M2 = np.float32(1.0)
"""Squared distance of first and last point below which an edge is closed."""
NONE = -1
OFF_M = 1.0
"""Who is farther off the road than this does not leave it (driveways, parking lots)."""
SLACK_M = 0.05
"""Changes of the distance below this are ignored."""


class RoadError(ValueError):
    """A map without any road edge to measure from."""


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


def build_road_edges(polylines_m: Sequence[Float32[np.ndarray, "_ 3"]]) -> RoadEdges:
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
        stretched_m = line_m * np.array([1, 1, HEIGHT_SCALE], dtype=np.float32)
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
    closed = closable and ((line_m[0] - line_m[-1]) ** 2).sum() < CLOSED_GAP_M2
    if not closed:
        before[0] = after[-1] = NONE
    return before, after


def scene_road_edges(scene: Scene, *, flat: bool = False) -> RoadEdges | None:
    """Road edges of a scene, in its own frame; None if it has none.

    Args:
        scene: The scene.
        flat: Set all heights to zero.
    """
    rows = scene.road_map.rows(FeatureType.ROAD_EDGE)
    flatten = np.array([1, 1, not flat], dtype=np.float32)
    lines_m = [scene.road_map.points(row) * flatten for row in rows.tolist()]
    return build_road_edges(lines_m) if any(len(line) >= 2 for line in lines_m) else None


def signed_distance_m(
    points_m: Float32[np.ndarray, "point 3"], edges: RoadEdges
) -> Float32[np.ndarray, " point"]:
    """Distance in the plane to the edge segment nearest in space; positive on its right."""
    stretched_m = points_m * np.array([1, 1, HEIGHT_SCALE], dtype=np.float32)
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


def leaves_road(
    before_m: Float32[np.ndarray, "*agent"], after_m: Float32[np.ndarray, "*agent"]
) -> Bool[np.ndarray, "*agent"]:
    """Tell whose signed distance says that it leaves the road, or gets farther off it."""
    farther = after_m > np.maximum(before_m, 0) + np.float32(SLACK_M)
    left: np.ndarray = farther & (before_m < OFF_M)
    return left


def project(
    to_point_m: Float32[np.ndarray, "... 2"], along_m: Float32[np.ndarray, "... 2"]
) -> Float32[np.ndarray, "..."]:
    """How far along a segment a point lies: 0 at its start, 1 at its end, not clipped."""
    length_m2 = _dot(along_m, along_m)
    share = _dot(to_point_m, along_m) / np.where(length_m2 > 0, length_m2, 1)
    return np.where(length_m2 > 0, share, np.float32(0))


def _dot(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    return a_m[..., 0] * b_m[..., 0] + a_m[..., 1] * b_m[..., 1]


def _cross(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    return a_m[..., 0] * b_m[..., 1] - a_m[..., 1] * b_m[..., 0]
