"""Turns at junctions: by how much vehicles have turned when they leave one."""

import numpy as np
from jaxtyping import Float64

from infgen.metrics.proper.engineering.vehicles import Vehicles, turned_rad
from infgen.scene import LinkType, RoadMap

JUNCTION_M = 25.0
"""A vehicle passes a junction where it gets so near to its middle, and leaves again."""
CORE_M = 12.0
"""Whoever does not get so near has passed it by."""
SAME_JUNCTION_M = 30.0
"""Places where lanes branch that are nearer to each other are one junction."""


def find_junctions(road_map: RoadMap) -> Float64[np.ndarray, "junction 2"]:
    """Find the middles of junctions: where lanes end that at least two others go on from.

    Branching places are joined, in the order of the map, to the first junction near by.
    """
    exits = road_map.link_lane_id[road_map.link_type == LinkType.EXIT]
    lanes, ways = np.unique(exits, return_counts=True)
    rows = np.flatnonzero(np.isin(road_map.feature_id, lanes[ways > 1]))
    last = road_map.point_offsets[rows + 1] - 1
    groups: list[list[np.ndarray]] = []
    for place_m in road_map.xyz_m[last, :2].astype(np.float64):
        near = [g for g in groups if np.hypot(*(g[0] - place_m)) < SAME_JUNCTION_M]
        if near:
            near[0].append(place_m)
        else:
            groups.append([place_m])
    return np.array([np.mean(group, axis=0) for group in groups]).reshape(-1, 2)


def turns_deg(
    vehicles: Vehicles, junctions_m: Float64[np.ndarray, "junction 2"]
) -> Float64[np.ndarray, " value"]:
    """Turn of each vehicle from entering a junction to leaving it, left turns above 0.

    Only passages that both begin and end in sight count.
    """
    found = []
    for middle_m in junctions_m:
        away_m = np.hypot(vehicles.x_m - middle_m[0], vehicles.y_m - middle_m[1])
        inside = vehicles.near & (away_m < JUNCTION_M)
        outside = vehicles.near & (away_m >= JUNCTION_M)
        edge = np.diff(np.pad(inside.astype(np.int8), ((0, 0), (1, 1))), axis=1)
        vehicle, first = np.nonzero(edge == 1)
        _, after = np.nonzero(edge == -1)  # The same vehicles in the same order.
        last_step = inside.shape[1] - 1
        for row, begin, end in zip(
            *map(np.ndarray.tolist, (vehicle, first, after)), strict=True
        ):
            if begin == 0 or end > last_step:
                continue
            seen = outside[row, begin - 1] and outside[row, end]
            if seen and away_m[row, begin:end].min() < CORE_M:
                one_rad, other_rad = vehicles.heading_rad[row, [begin, end]][:, None]
                found.append(float(np.degrees(turned_rad(one_rad, other_rad)[0])))
    return np.array(found, dtype=np.float64)
