"""Distance of boxes to the nearest road edge: that of the corner that is farthest off."""

import numpy as np
from jaxtyping import Float32, Int64

from infgen.metrics.motion import Motion
from infgen.spatial.road_edges import RoadEdges, signed_distance_m

NO_ROAD_M = np.float32(-1e10)
"""Distance of a box that is not there."""


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
