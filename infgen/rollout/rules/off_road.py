"""Off-road check: vehicles that leave the road if they repeat their motion token."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int64

from infgen.geometry import box_corners, grid_squares
from infgen.rollout.population import Population
from infgen.scene import AgentType, FeatureType, Scene
from infgen.spatial.lanes import LANE_M, lanes_distance_m
from infgen.spatial.road_edges import (
    RoadEdges,
    leaves_road,
    scene_road_edges,
    signed_distance_m,
)

POINT_M = 0.5
"""Distances are computed at points this far apart, and interpolated."""
TILE = 32
"""Points along a side of a tile; its distances are computed when a vehicle gets there."""

Lanes = tuple[Float32[np.ndarray, "segment 3"], Float32[np.ndarray, "segment 3"]]
"""Lane segments in the plane: first points, and vectors to their last points."""


class RoadEdgeTiles:
    """Distance to the road edge on one map, tile by tile, in the plane."""

    def __init__(self, scene: Scene) -> None:
        """Prepare; tiles are computed on demand."""
        self._edges = scene_road_edges(scene, flat=True)
        self._lanes = lane_segments(scene)
        self._row: dict[int, int] = {}
        self._off_m = np.zeros((0, TILE + 1, TILE + 1), dtype=np.float32)

    def off_m(self, xy_m: Float32[np.ndarray, "point 2"]) -> Float32[np.ndarray, " point"]:
        """Signed distance of points to the road edge; positive off the road.

        Points near a lane are on the road, and so is every point of a map without edges.
        """
        if self._edges is None or not len(xy_m):
            return np.full(len(xy_m), -np.inf, dtype=np.float32)
        at = np.floor(xy_m / POINT_M).astype(np.int64)
        x, y = (at % TILE).T
        u, v = (xy_m / POINT_M - at).astype(np.float32).T
        tile = self._tiles(xy_m, at - at % TILE, self._edges)
        off_m = self._off_m
        near_m = off_m[tile, x, y] * (1 - u) + off_m[tile, x + 1, y] * u
        far_m = off_m[tile, x, y + 1] * (1 - u) + off_m[tile, x + 1, y + 1] * u
        return near_m * (1 - v) + far_m * v

    def _tiles(
        self,
        xy_m: Float32[np.ndarray, "point 2"],
        corner: Int64[np.ndarray, "point 2"],
        edges: RoadEdges,
    ) -> Int64[np.ndarray, " point"]:
        """Row of the tile of each point; ``corner`` is the first point of the tile."""
        number, first, which = np.unique(
            grid_squares(xy_m, POINT_M * TILE), return_index=True, return_inverse=True
        )
        tiles = number.tolist()
        new = [at for at, tile in enumerate(tiles) if tile not in self._row]
        if new:
            self._row |= {tiles[at]: len(self._row) + i for i, at in enumerate(new)}
            measured = self._measure(corner[first[new]], edges)
            self._off_m = np.concatenate([self._off_m, measured])
        return np.array([self._row[tile] for tile in tiles], dtype=np.int64)[which]

    def _measure(
        self, corner: Int64[np.ndarray, "tile 2"], edges: RoadEdges
    ) -> Float32[np.ndarray, "tile side side"]:
        """Compute the distances of tiles, up to the first points of the next tiles."""
        steps = np.arange(TILE + 1)
        place = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
        at = corner[:, None, None] + place
        points_m = np.zeros((at[..., 0].size, 3), dtype=np.float32)
        points_m[:, :2] = at.reshape(-1, 2) * np.float32(POINT_M)
        off_m = signed_distance_m(points_m, edges)
        off = np.flatnonzero(off_m > 0)
        lane_m = lanes_distance_m(points_m[off], *self._lanes) - np.float32(LANE_M)
        off_m[off] = np.minimum(off_m[off], lane_m)
        return off_m.reshape(at.shape[:-1])


def lane_segments(scene: Scene) -> Lanes:
    """Return all lane segments of a map."""
    road_map = scene.road_map
    flat_m = road_map.xyz_m * np.array([1, 1, 0], dtype=np.float32)
    feature = np.repeat(np.arange(road_map.num_features), np.diff(road_map.point_offsets))
    lane = road_map.feature_type[feature[:-1]] == FeatureType.LANE
    (row,) = np.nonzero(lane & (feature[:-1] == feature[1:]))
    return flat_m[row], flat_m[row + 1] - flat_m[row]


def find_off_road(
    before: Population,
    which: Bool[np.ndarray, "rollout row"],
    poses: Float32[np.ndarray, "rollout row time 3"],
    moments: Int64[np.ndarray, "rollout row"],
    road_edge_tiles: Sequence[RoadEdgeTiles],
    scene: Int64[np.ndarray, " rollout"],
) -> Bool[np.ndarray, "rollout row"]:
    """Tell which vehicles leave the road, or get farther off it.

    Args:
        before: All agents at the beginning of the token step.
        which: Agents to check.
        poses: Predicted poses.
        moments: Number of these that count for each agent.
        road_edge_tiles: Of each map.
        scene: Map of each rollout.
    """
    departs = np.zeros(which.shape, dtype=bool)
    vehicle = which & (before.agent_type == AgentType.VEHICLE)
    for at, edge in enumerate(road_edge_tiles):
        rollout, row = np.nonzero(vehicle & (scene == at)[:, None])
        path = np.concatenate(
            [before.pose[rollout, row, None], poses[rollout, row]], axis=1
        )
        counts = np.arange(path.shape[1]) <= moments[rollout, row, None]  # now, and then
        who, moment = np.nonzero(counts)
        size_lw_m = before.size_lwh_m[rollout[who], row[who], :2]
        corners_m = box_corners(path[who, moment], size_lw_m)
        off_m = np.full((*counts.shape, 4), -np.inf, dtype=np.float32)
        off_m[counts] = edge.off_m(corners_m.reshape(-1, 2)).reshape(-1, 4)
        now_m, then_m = off_m[:, 0].max(axis=1), off_m[:, 1:].max(axis=(1, 2))
        departs[rollout, row] = leaves_road(now_m, then_m)
    return departs
