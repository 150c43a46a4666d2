"""One driving log: tracks, map and traffic signals.

World frame: right-handed, z up, metres, relative to ``Scene.origin_xyz_m``; headings
counter-clockwise from +x. Enum values are those of the Waymo Open Motion Dataset (WOMD)
unless stated. Records are valid from construction on: shapes are in the annotations
(checked while tests run), and ``Scene`` refuses rows out of range.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int16, Int32, Int64


class SceneError(ValueError):
    """A log whose fields contradict each other."""


class AgentType(IntEnum):
    """Road users. WOMD's object type less one."""

    VEHICLE = 0
    PEDESTRIAN = 1
    CYCLIST = 2
    OTHER = 3


class FeatureType(IntEnum):
    """Map features. The field numbers of WOMD's ``MapFeature``."""

    LANE = 3
    ROAD_LINE = 4
    ROAD_EDGE = 5
    STOP_SIGN = 7
    CROSSWALK = 8
    SPEED_BUMP = 9
    DRIVEWAY = 10


class LaneType(IntEnum):
    """Sub-types of ``FeatureType.LANE``."""

    UNDEFINED = 0
    FREEWAY = 1
    SURFACE_STREET = 2
    BIKE_LANE = 3


class RoadLineType(IntEnum):
    """Sub-types of ``FeatureType.ROAD_LINE``."""

    UNKNOWN = 0
    BROKEN_SINGLE_WHITE = 1
    SOLID_SINGLE_WHITE = 2
    SOLID_DOUBLE_WHITE = 3
    BROKEN_SINGLE_YELLOW = 4
    BROKEN_DOUBLE_YELLOW = 5
    SOLID_SINGLE_YELLOW = 6
    SOLID_DOUBLE_YELLOW = 7
    PASSING_DOUBLE_YELLOW = 8


class RoadEdgeType(IntEnum):
    """Sub-types of ``FeatureType.ROAD_EDGE``."""

    UNKNOWN = 0
    BOUNDARY = 1
    MEDIAN = 2


class SignalState(IntEnum):
    """State of a traffic signal for one lane."""

    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


class Side(IntEnum):
    """A side of a lane, seen along it."""

    LEFT = 0
    RIGHT = 1


class LinkType(IntEnum):
    """How one lane connects to another."""

    ENTRY = 0
    EXIT = 1


@dataclass(frozen=True, slots=True)
class Tracks:
    """The logged motion of every agent of one scene.

    One row per agent in the order of the log, one column per 0.1 s step. Where ``valid`` is
    False the values are those of the record; only the official metric reads them.

    Attributes:
        id: Track id, unique within the scene.
        agent_type: ``AgentType`` of each agent.
        xyz_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        velocity_mps: Velocity along world x and y.
        size_lwh_m: Length, width and height of each box at each step.
        valid: Whether the agent was observed at that step.
    """

    id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    xyz_m: Float32[np.ndarray, "agent step 3"]
    heading_rad: Float32[np.ndarray, "agent step"]
    velocity_mps: Float32[np.ndarray, "agent step 2"]
    size_lwh_m: Float32[np.ndarray, "agent step 3"]
    valid: Bool[np.ndarray, "agent step"]

    @property
    def num_agents(self) -> int:
        """Number of agents in the log."""
        return int(self.valid.shape[0])

    @property
    def num_steps(self) -> int:
        """Number of 0.1 s steps in the log."""
        return int(self.valid.shape[1])

    def pose(self, step: int) -> Float32[np.ndarray, "agent 3"]:
        """Poses [agent, 3] at one step: x, y in metres, heading in radians."""
        return np.column_stack([self.xyz_m[:, step, :2], self.heading_rad[:, step]])


@dataclass(frozen=True, slots=True)
class RoadMap:
    """The static map: features in the order of the log, their points laid end to end.

    Points of feature ``f`` are ``xyz_m[point_offsets[f] : point_offsets[f + 1]]``: the
    polyline of a lane, road line or road edge, the outline of a crosswalk, speed bump or
    driveway, the single point of a stop sign. Tables below (``link``, ``neighbour``,
    ``boundary``, ``sign``) have one row per relation, in the order of the record; ids are
    feature ids of the record, which may name features that the record does not hold.

    Attributes:
        feature_id: WOMD feature id.
        feature_type: ``FeatureType``.
        feature_subtype: ``LaneType``, ``RoadLineType`` or ``RoadEdgeType`` by kind; else 0.
        speed_limit_mph: Of lanes; 0 where unknown.
        interpolating: Lane that bridges a gap between two others.
        point_offsets: First point of each feature, and the number of points.
        xyz_m: All points.
        link_lane_id: Lane, its ``LinkType`` to the other, and the other.
        neighbour_lane_id: Lane with a neighbour on ``neighbour_side`` (``Side``) named
            ``neighbour_other_id``; ``neighbour_span`` holds first and last point index
            along the lane, then along the neighbour.
        boundary_lane_id: Lane whose ``boundary_side`` runs along feature
            ``boundary_feature_id`` of ``boundary_type`` (``RoadLineType``);
            ``boundary_span`` holds first and last point index of the lane.
            ``boundary_neighbour`` is the row of the neighbour table that the boundary
            separates from, or -1 for a boundary of the lane itself.
        sign_id: Stop sign, and ``sign_lane_id`` that it controls.
    """

    feature_id: Int64[np.ndarray, " feature"]
    feature_type: Int8[np.ndarray, " feature"]
    feature_subtype: Int8[np.ndarray, " feature"]
    speed_limit_mph: Float32[np.ndarray, " feature"]
    interpolating: Bool[np.ndarray, " feature"]
    point_offsets: Int64[np.ndarray, " feature+1"]
    xyz_m: Float32[np.ndarray, "point 3"]
    link_lane_id: Int64[np.ndarray, " link"]
    link_type: Int8[np.ndarray, " link"]
    link_other_id: Int64[np.ndarray, " link"]
    neighbour_lane_id: Int64[np.ndarray, " neighbour"]
    neighbour_side: Int8[np.ndarray, " neighbour"]
    neighbour_other_id: Int64[np.ndarray, " neighbour"]
    neighbour_span: Int32[np.ndarray, "neighbour 4"]
    boundary_lane_id: Int64[np.ndarray, " boundary"]
    boundary_side: Int8[np.ndarray, " boundary"]
    boundary_feature_id: Int64[np.ndarray, " boundary"]
    boundary_type: Int8[np.ndarray, " boundary"]
    boundary_span: Int32[np.ndarray, "boundary 2"]
    boundary_neighbour: Int32[np.ndarray, " boundary"]
    sign_id: Int64[np.ndarray, " sign"]
    sign_lane_id: Int64[np.ndarray, " sign"]

    @property
    def num_features(self) -> int:
        """Number of map features."""
        return len(self.feature_id)

    def points(self, feature: int) -> Float32[np.ndarray, "length 3"]:
        """Points [length, 3] of one feature, by row."""
        return self.xyz_m[self.point_offsets[feature] : self.point_offsets[feature + 1]]

    def rows(self, kind: FeatureType) -> Int64[np.ndarray, " row"]:
        """Rows of all features of one kind."""
        return np.flatnonzero(self.feature_type == kind)


@dataclass(frozen=True, slots=True)
class Signals:
    """Traffic signal states: one row per step and signalled lane, steps ascending.

    Attributes:
        step: 0.1 s step of the row.
        lane_id: Feature id of the lane that the signal controls.
        state: ``SignalState``.
        stop_xyz_m: Where the lane's traffic stops.
    """

    step: Int16[np.ndarray, " signal"]
    lane_id: Int64[np.ndarray, " signal"]
    state: Int8[np.ndarray, " signal"]
    stop_xyz_m: Float32[np.ndarray, "signal 3"]


@dataclass(frozen=True, slots=True)
class Scene:
    """One log: tracks, map and signals, in metres around an origin.

    The origin is a whole number of metres, so that a float32 can hold it and the record's
    own zeros (its invalid states) come back as exact zeros.

    Attributes:
        scenario_id: Id of the log.
        origin_xyz_m: World position of the local origin, to add to any ``xyz_m``.
        timestamps_s: Time of each step.
        now: Last step of the history (WOMD's ``current_time_index``).
        ego: Row of the recording car (WOMD's ``sdc_track_index``).
        predict_row: Rows of the tracks to predict, and ``predict_difficulty`` of each.
        interest_id: Track ids of the objects of interest.
        lights_recorded: Whether the log says where traffic lights are. If not, that it has
            no signals says nothing, and scores that need them are not measured.
    """

    scenario_id: str
    origin_xyz_m: Float64[np.ndarray, "3"]
    timestamps_s: Float64[np.ndarray, " step"]
    now: int
    ego: int
    predict_row: Int32[np.ndarray, " predict"]
    predict_difficulty: Int8[np.ndarray, " predict"]
    interest_id: Int32[np.ndarray, " interest"]
    tracks: Tracks
    road_map: RoadMap
    signals: Signals
    lights_recorded: bool = True

    def __post_init__(self) -> None:
        """Refuse a scene with rows or steps out of range.

        Raises:
            SceneError: naming the field, its value and what it must be.
        """
        agents, steps = self.tracks.valid.shape
        if not 0 <= self.ego < agents:
            raise SceneError(f"ego row {self.ego} is not one of the {agents} tracks")
        if len(self.timestamps_s) != steps:
            raise SceneError(f"{len(self.timestamps_s)} timestamps for {steps} steps")
        if not 0 <= self.now < steps:
            raise SceneError(f"current step {self.now} is not one of the {steps} steps")
        for row in self.predict_row:
            if not 0 <= row < agents:
                raise SceneError(
                    f"track to predict {row} is not one of the {agents} tracks"
                )


def world_xyz_m(
    scene: Scene, xyz_m: Float32[np.ndarray, "*shape 3"]
) -> Float32[np.ndarray, "*shape 3"]:
    """Return world positions as the official metric has them: in float32.

    They equal the record's doubles rounded to float32, but for the last bit of the float32
    around the origin. The record's zeros are exact zeros.
    """
    return (xyz_m + scene.origin_xyz_m).astype(np.float32)
