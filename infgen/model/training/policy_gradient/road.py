"""How far boxes are off the road, by the map tokens of a batch.

In the plane: batches know no heights. Road edges have the road on their left; points near a
lane are on the road, as in the off-road rule (``rollout.rules.off_road``).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from infgen.geometry import box_corners, rotate
from infgen.model.batching.batch import MapTokens
from infgen.spatial.lanes import LANE_M, lanes_distance_m
from infgen.spatial.road_edges import RoadEdges, build_road_edges, signed_distance_m
from infgen.tokens.map import PolylineType
from infgen.tokens.vocabulary import MapVocabulary


@dataclass(frozen=True, slots=True)
class Road:
    """The road of one map.

    Attributes:
        edges: Its edges; None if it has none.
        lane_start_m: First points of the lane tokens, and ...
        lane_along_m: ... vectors to their last points.
    """

    edges: RoadEdges | None
    lane_start_m: Float32[np.ndarray, "lane 3"]
    lane_along_m: Float32[np.ndarray, "lane 3"]

    def off_m(
        self, pose: Float32[np.ndarray, "box 3"], size_lw_m: Float32[np.ndarray, "box 2"]
    ) -> Float32[np.ndarray, " box"]:
        """Signed distance of the corner farthest off the road; minus infinity off a map."""
        if self.edges is None or not len(pose):
            return np.full(len(pose), -np.inf, dtype=np.float32)
        corners_m = box_corners(pose, size_lw_m).reshape(-1, 2)
        points_m = np.pad(corners_m, ((0, 0), (0, 1))).astype(np.float32)
        off_m = signed_distance_m(points_m, self.edges)
        off = np.flatnonzero(off_m > 0)
        lane_m = lanes_distance_m(points_m[off], self.lane_start_m, self.lane_along_m)
        off_m[off] = np.minimum(off_m[off], lane_m - np.float32(LANE_M))
        farthest_m: np.ndarray = off_m.reshape(-1, 4).max(axis=1)
        return farthest_m


def read_roads(roads: MapTokens, vocabulary: MapVocabulary) -> list[Road]:
    """Draw the road of every scene from its map tokens."""
    real, pose, token, kind, follows = (
        each.numpy(force=True)
        for each in (
            roads.real,
            roads.pose,
            roads.token,
            roads.polyline_type,
            roads.follows,
        )
    )
    found = []
    for scene in range(len(real)):
        (edge,) = np.nonzero(real[scene] & (kind[scene] == PolylineType.ROAD_EDGE))
        (lane,) = np.nonzero(real[scene] & (kind[scene] == PolylineType.LANE))
        points_m = _points_m(pose[scene], token[scene], vocabulary)
        lines_m = _joined(points_m, edge, follows[scene])
        start_m, end_m = points_m[lane, 0], points_m[lane, -1]
        edges = build_road_edges(lines_m) if lines_m else None
        found.append(Road(edges, start_m, end_m - start_m))
    return found


def _points_m(
    pose: np.ndarray, token: np.ndarray, vocabulary: MapVocabulary
) -> Float32[np.ndarray, "road 3 3"]:
    """First, middle and last points of map tokens, at height zero."""
    shape_m = vocabulary.sample_m[token]  # [road, point, 2]
    xy_m = rotate(shape_m, pose[:, None, 2]) + pose[:, None, :2]
    return np.pad(xy_m, ((0, 0), (0, 0), (0, 1))).astype(np.float32)


def _joined(
    points_m: np.ndarray, rows: Int64[np.ndarray, " edge"], follows: np.ndarray
) -> list[Float32[np.ndarray, "_ 3"]]:
    """Join the tokens of each line; each begins where its own first point is."""
    if not len(rows):
        return []
    goes_on = follows[rows] & (np.diff(rows, prepend=-2) == 1)
    begins = np.flatnonzero(~goes_on)
    return [
        np.concatenate([points_m[line, :-1].reshape(-1, 3), points_m[line[-1], -1:]])
        for line in np.split(rows, begins[1:])
    ]
