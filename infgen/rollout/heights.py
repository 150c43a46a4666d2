"""Heights: the model plays in the plane; boxes stand on the nearest road."""

import numpy as np
from jaxtyping import Float32

BLOCK = 4096


def ground_z_m(
    xy_m: Float32[np.ndarray, "point 2"],
    road_xy_m: Float32[np.ndarray, "road 2"],
    road_z_m: Float32[np.ndarray, " road"],
) -> Float32[np.ndarray, " point"]:
    """Height [point] of the road point nearest to each point; 0 on an empty map."""
    if not len(road_xy_m):
        return np.zeros(len(xy_m), dtype=np.float32)
    square_m2 = (road_xy_m**2).sum(axis=1) / 2
    nearest = [
        (square_m2 - xy_m[at : at + BLOCK] @ road_xy_m.T).argmin(axis=1)
        for at in range(0, len(xy_m), BLOCK)
    ]
    return road_z_m[np.concatenate([np.empty(0, dtype=np.int64), *nearest])]
