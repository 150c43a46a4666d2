"""Argoverse 2's categories as agent types, and the boxes that its motion tracks lack.

Decisions, with their reasons, are in ``docs/sources.md``. What is not listed is ``OTHER``.
"""

from collections.abc import Mapping

from infgen.scene import AgentType, LaneType, RoadLineType

_VEHICLE, _PEDESTRIAN = AgentType.VEHICLE, AgentType.PEDESTRIAN
_CYCLIST, _OTHER = AgentType.CYCLIST, AgentType.OTHER

MOTION_TYPES: Mapping[str, AgentType] = {
    "vehicle": _VEHICLE,
    "bus": _VEHICLE,
    "pedestrian": _PEDESTRIAN,
    "cyclist": _CYCLIST,
    "motorcyclist": _CYCLIST,
    "riderless_bicycle": _OTHER,
    "static": _OTHER,
    "background": _OTHER,
    "construction": _OTHER,
    "unknown": _OTHER,
}
"""``object_type`` of motion forecasting."""

MOTION_SIZES_LWH_M: Mapping[str, tuple[float, float, float]] = {
    "vehicle": (4.6, 2.0, 1.7),
    "bus": (12.0, 2.9, 3.3),
    "pedestrian": (0.8, 0.8, 1.75),
    "cyclist": (1.9, 0.8, 1.75),
    "motorcyclist": (2.2, 0.9, 1.75),
    "riderless_bicycle": (1.8, 0.6, 1.1),
}
"""Nominal boxes: motion forecasting has none. Medians of such boxes in other logs."""
OTHER_SIZE_LWH_M = (1.0, 1.0, 1.0)

SENSOR_TYPES: Mapping[str, AgentType] = {
    "REGULAR_VEHICLE": _VEHICLE,
    "LARGE_VEHICLE": _VEHICLE,
    "BUS": _VEHICLE,
    "SCHOOL_BUS": _VEHICLE,
    "ARTICULATED_BUS": _VEHICLE,
    "BOX_TRUCK": _VEHICLE,
    "TRUCK": _VEHICLE,
    "TRUCK_CAB": _VEHICLE,
    "VEHICULAR_TRAILER": _VEHICLE,
    "RAILED_VEHICLE": _VEHICLE,
    "PEDESTRIAN": _PEDESTRIAN,
    "OFFICIAL_SIGNALER": _PEDESTRIAN,
    "WHEELCHAIR": _PEDESTRIAN,
    "BICYCLIST": _CYCLIST,
    "MOTORCYCLIST": _CYCLIST,
    "WHEELED_RIDER": _CYCLIST,
}
"""``category`` of sensor logs."""

EGO_SIZE_LWH_M = (4.877, 2.0, 1.473)
"""Box of the recording car, a Ford Fusion Hybrid ..."""
EGO_CENTRE_M = (1.422, 0.0, 0.25)
"""... and its centre in the ego frame, whose origin is the middle of the rear axle."""

LANE_TYPES: Mapping[str, LaneType] = {
    "VEHICLE": LaneType.SURFACE_STREET,
    "BUS": LaneType.SURFACE_STREET,
    "BIKE": LaneType.BIKE_LANE,
}

NO_MARK = "NONE"
MARK_TYPES: Mapping[str, RoadLineType] = {
    "DASHED_WHITE": RoadLineType.BROKEN_SINGLE_WHITE,
    "DOUBLE_DASH_WHITE": RoadLineType.BROKEN_SINGLE_WHITE,
    "SOLID_WHITE": RoadLineType.SOLID_SINGLE_WHITE,
    "SOLID_BLUE": RoadLineType.SOLID_SINGLE_WHITE,
    "DOUBLE_SOLID_WHITE": RoadLineType.SOLID_DOUBLE_WHITE,
    "DASH_SOLID_WHITE": RoadLineType.SOLID_DOUBLE_WHITE,
    "SOLID_DASH_WHITE": RoadLineType.SOLID_DOUBLE_WHITE,
    "DASHED_YELLOW": RoadLineType.BROKEN_SINGLE_YELLOW,
    "DOUBLE_DASH_YELLOW": RoadLineType.BROKEN_DOUBLE_YELLOW,
    "SOLID_YELLOW": RoadLineType.SOLID_SINGLE_YELLOW,
    "DOUBLE_SOLID_YELLOW": RoadLineType.SOLID_DOUBLE_YELLOW,
    "DASH_SOLID_YELLOW": RoadLineType.PASSING_DOUBLE_YELLOW,
    "SOLID_DASH_YELLOW": RoadLineType.PASSING_DOUBLE_YELLOW,
}
"""Mark types of lane boundaries; ``UNKNOWN`` and what is not listed is an unknown line."""
