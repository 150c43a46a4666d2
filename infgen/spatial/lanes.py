"""Distance of points to the nearest lane."""

import numpy as np
from jaxtyping import Float32

from infgen.spatial.nearest import nearest_by_cells
from infgen.spatial.road_edges import project

LANE_M = 1.2
"""Points this near to a lane centre are on the road, whatever edge is near (bridges)."""


def lanes_distance_m(
    points_m: Float32[np.ndarray, "point 3"],
    start_m: Float32[np.ndarray, "segment 3"],
    along_m: Float32[np.ndarray, "segment 3"],
) -> Float32[np.ndarray, " point"]:
    """Distance of points to the nearest segment; infinite if there is none."""
    if not len(start_m):
        return np.full(len(points_m), np.inf, dtype=np.float32)
    nearest = nearest_by_cells(points_m, start_m, along_m)
    along_m, away_m = along_m[nearest, :2], (points_m - start_m[nearest])[:, :2]
    share = np.clip(project(away_m, along_m), 0, 1)
    return np.linalg.norm(away_m - share[:, None] * along_m, axis=1).astype(np.float32)
