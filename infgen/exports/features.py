"""What the formats of others ask of a map: features with their points, and their names."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from infgen.scene import (
    AgentType,
    FeatureType,
    LaneType,
    LinkType,
    RoadEdgeType,
    RoadLineType,
    RoadMap,
    Scene,
    SignalState,
)

DECIMALS = 4
"""Positions and velocities are written to a tenth of a millimetre (per second) ..."""
ANGLE_DECIMALS = 6
"""... and headings to a millionth of a radian."""


class Feature(NamedTuple):
    """One feature of a map.

    Attributes:
        row: In the map's table.
        id: WOMD feature id.
        kind: What it is.
        type: Sub-type of its kind; 0 where its kind has none.
        xyz_m: Its points, world frame.
    """

    row: int
    id: int
    kind: FeatureType
    type: int
    xyz_m: Float64[np.ndarray, "point 3"]


def features_of(scene: Scene) -> Iterator[Feature]:
    """Yield all features that have points, in the order of the log."""
    road_map = scene.road_map
    world_m = road_map.xyz_m.astype(np.float64) + scene.origin_xyz_m
    for row in range(road_map.num_features):
        part = slice(*road_map.point_offsets[row : row + 2].tolist())
        if part.start < part.stop:
            yield Feature(
                row,
                int(road_map.feature_id[row]),
                FeatureType(road_map.feature_type[row]),
                int(road_map.feature_subtype[row]),
                world_m[part],
            )


def linked(road_map: RoadMap, kind: LinkType) -> Mapping[int, list[int]]:
    """Lanes before (``ENTRY``) or after (``EXIT``) each lane, by its id."""
    found: dict[int, list[int]] = {}
    rows = np.flatnonzero(road_map.link_type == kind)
    pairs = zip(road_map.link_lane_id[rows], road_map.link_other_id[rows], strict=True)
    for lane, other in pairs:
        found.setdefault(int(lane), []).append(int(other))
    return found


def womd_name(feature: Feature) -> str:
    """Name a feature's sub-type in capitals, as WOMD's tools do."""
    if feature.kind == FeatureType.LANE:
        word = LaneType(feature.type).name
        return f"LANE_{'UNKNOWN' if word == 'UNDEFINED' else word}"
    if feature.kind == FeatureType.ROAD_LINE:
        return f"ROAD_LINE_{RoadLineType(feature.type).name}"
    if feature.kind == FeatureType.ROAD_EDGE:
        return f"ROAD_EDGE_{RoadEdgeType(feature.type).name}"
    return feature.kind.name


def agent_name(kind: int) -> str:
    """Name a kind of agent in capitals."""
    return AgentType(kind).name


def light_name(state: int) -> str:
    """Name what a light shows in capitals."""
    return SignalState(state).name


def rounded(values: np.ndarray, decimals: int = DECIMALS) -> list[Any]:
    """Give numbers as nested lists, with so many decimals."""
    return np.round(values.astype(np.float64), decimals).tolist()
