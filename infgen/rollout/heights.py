"""Heights: the model plays in the plane; boxes stand on the nearest road."""

import numpy as np
from jaxtyping import Float32

from infgen.geometry import grid_squares

SQUARE_M = 16.0
"""Points are looked up by squares: to all in one, few road points can be the nearest."""
_SLACK_M = 0.1
"""Room for rounding, where it is decided which road points can be."""


def ground_z_m(
    xy_m: Float32[np.ndarray, "point 2"],
    road_xy_m: Float32[np.ndarray, "road 2"],
    map_z_m: Float32[np.ndarray, " road"],
) -> Float32[np.ndarray, " point"]:
    """Height [point] of the road point nearest to each point; 0 on an empty map."""
    found = np.zeros(len(xy_m), dtype=np.float32)
    if not len(road_xy_m) or not len(xy_m):
        return found
    square_m2 = (road_xy_m**2).sum(axis=1) / 2
    number = grid_squares(xy_m, SQUARE_M)
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=number[order[0]] - 1))
    for rows in np.split(order, starts[1:]):
        middle_m = (np.floor(xy_m[rows[0]] / SQUARE_M) + 0.5) * SQUARE_M
        away_m = np.hypot(*(road_xy_m - middle_m.astype(np.float32)).T)
        (near,) = np.nonzero(away_m <= away_m.min() + SQUARE_M * 2**0.5 + _SLACK_M)
        nearest = (square_m2[near] - xy_m[rows] @ road_xy_m[near].T).argmin(axis=1)
        found[rows] = map_z_m[near[nearest]]
    return found
