"""The log as the official metric reads it: world coordinates rounded to float32.

The metric's bin edges are near enough for rounding to matter, so it is scored in world
coordinates, where a float32 holds about half a millimetre, raw values of unobserved steps
included.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, Int64

from infgen.metrics.motion import Motion
from infgen.metrics.wosac.evaluated import choose_evaluated
from infgen.scene import AgentType, FeatureType, LaneType, Scene, world_xyz_m

HISTORY_STEPS = 11
"""Steps up to and with now."""
FUTURE_STEPS = 80
LOG_STEPS = HISTORY_STEPS + FUTURE_STEPS
NOW = HISTORY_STEPS - 1


_OF_AGENTS = (
    "id",
    "agent_type",
    "x_m",
    "y_m",
    "z_m",
    "heading_rad",
    "size_lwh_m",
    "valid",
)
"""What of a log has a row per agent."""


class LogError(ValueError):
    """A log that the official metric cannot score."""


@dataclass(frozen=True, slots=True)
class LoggedScene:
    """What the official metric needs of a log: 91 steps, the eleventh of them now.

    World frame. Agents are all tracks of the record in its order.

    Attributes:
        scenario_id: Id of the log.
        id: Track ids.
        agent_type: ``AgentType``.
        x_m: Box centres.
        y_m: Box centres.
        z_m: Box centres.
        heading_rad: Counter-clockwise from +x.
        size_lwh_m: Boxes now.
        valid: Whether the agent was observed at that step.
        ego: Row of the recording car.
        predict_row: Rows of the tracks to predict; chosen where the record names none.
        edge_offsets: First point of each road edge, and the number of points.
        edge_m: Points of all road edges.
        lane_id: Ids of the surface-street lanes.
        lane_offsets: First point of each of them, and the number of points.
        lane_m: Their points.
        signal_lane_id: Lane of each signal.
        signal_state: ``SignalState``; 0 where the log has none.
        signal_stop_m: Stop points; zero where the log has none.
        lights_recorded: As in ``Scene``.
    """

    scenario_id: str
    id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    x_m: Float32[np.ndarray, "agent 91"]
    y_m: Float32[np.ndarray, "agent 91"]
    z_m: Float32[np.ndarray, "agent 91"]
    heading_rad: Float32[np.ndarray, "agent 91"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    valid: Bool[np.ndarray, "agent 91"]
    ego: int
    predict_row: Int32[np.ndarray, " predict"]
    edge_offsets: Int64[np.ndarray, " edge_offset"]
    edge_m: Float32[np.ndarray, "edge_point 3"]
    lane_id: Int64[np.ndarray, " lane"]
    lane_offsets: Int64[np.ndarray, " lane+1"]
    lane_m: Float32[np.ndarray, "lane_point 3"]
    signal_lane_id: Int64[np.ndarray, " signal"]
    signal_state: Int8[np.ndarray, "signal 91"]
    signal_stop_m: Float32[np.ndarray, "signal 91 2"]
    lights_recorded: bool = True

    @property
    def sim_rows(self) -> Int64[np.ndarray, " sim"]:
        """Rows of the agents to simulate: those observed now, in the record's order."""
        return np.flatnonzero(self.valid[:, NOW])

    @property
    def evaluated(self) -> Int64[np.ndarray, " object"]:
        """Places among ``sim_rows`` of the evaluated agents, by ascending id.

        They are the ego and the tracks to predict.

        Raises:
            LogError: if one of them is not observed now.
        """
        rows = np.unique(np.append(self.predict_row, self.ego).astype(np.int64))
        rows = rows[np.argsort(self.id[rows], kind="stable")]
        for row in rows[~self.valid[rows, NOW]]:
            raise LogError(
                f"scene {self.scenario_id}: agent {self.id[row]} is to be evaluated "
                "but is not observed now"
            )
        return np.searchsorted(self.sim_rows, rows)

    @property
    def motion(self) -> Motion:
        """The logged motion of the agents to simulate, as one rollout."""
        rows = self.sim_rows
        return Motion(
            x_m=self.x_m[None, rows],
            y_m=self.y_m[None, rows],
            z_m=self.z_m[None, rows],
            heading_rad=self.heading_rad[None, rows],
            size_lwh_m=self.size_lwh_m[rows],
            agent_type=self.agent_type[rows],
            valid=self.valid[None, rows],
        )

    @property
    def others(self) -> Bool[np.ndarray, " agent"]:
        """Which agents are neither vehicles, pedestrians nor cyclists."""
        return (self.agent_type < 0) | (self.agent_type >= AgentType.OTHER)

    def road_users_only(self) -> "LoggedScene":
        """Return the log without agents of type "other"; the recording car stays."""
        kept = ~self.others
        kept[self.ego] = True
        rows, place = np.flatnonzero(kept), np.cumsum(kept) - 1
        cut = {name: getattr(self, name)[rows] for name in _OF_AGENTS}
        predict = self.predict_row[kept[self.predict_row]]
        return replace(
            self,
            ego=int(place[self.ego]),
            predict_row=place[predict].astype(np.int32),
            **cut,
        )

    def edges(self) -> list[Float32[np.ndarray, "_ 3"]]:
        """Points of each road edge."""
        return np.split(self.edge_m, self.edge_offsets[1:-1])

    def lanes(self) -> list[Float32[np.ndarray, "_ 3"]]:
        """Points of each surface-street lane."""
        return np.split(self.lane_m, self.lane_offsets[1:-1]) if len(self.lane_id) else []


def from_scene(scene: Scene) -> LoggedScene:
    """Bring a scene to world coordinates and 91 steps.

    Raises:
        LogError: if the log holds less than eight seconds after a history of one.
    """
    tracks = scene.tracks
    if scene.now != NOW or tracks.num_steps < LOG_STEPS:
        raise LogError(
            f"scene {scene.scenario_id} has {tracks.num_steps} steps with now at "
            f"{scene.now}; expected at least {LOG_STEPS} with now at {NOW}, where "
            f"ingest.now_step={NOW} sets it in scene files"
        )
    xyz_m = world_xyz_m(scene, tracks.xyz_m[:, :LOG_STEPS])
    edges = _features(scene, scene.road_map.rows(FeatureType.ROAD_EDGE))
    lanes = scene.road_map.rows(FeatureType.LANE)
    lanes = lanes[scene.road_map.feature_subtype[lanes] == LaneType.SURFACE_STREET]
    lanes = lanes[np.diff(scene.road_map.point_offsets)[lanes] >= 2]
    lane_m, lane_offsets = _features(scene, lanes)
    lane_id, state, stop_m = _signals(scene)
    predict = scene.predict_row
    if not len(predict):
        predict = choose_evaluated(tracks, scene.ego, slice(NOW, LOG_STEPS))
    return LoggedScene(
        scenario_id=scene.scenario_id,
        id=tracks.id,
        agent_type=tracks.agent_type,
        x_m=np.ascontiguousarray(xyz_m[..., 0]),
        y_m=np.ascontiguousarray(xyz_m[..., 1]),
        z_m=np.ascontiguousarray(xyz_m[..., 2]),
        heading_rad=tracks.heading_rad[:, :LOG_STEPS],
        size_lwh_m=tracks.size_lwh_m[:, NOW],
        valid=tracks.valid[:, :LOG_STEPS],
        ego=scene.ego,
        predict_row=predict,
        edge_m=edges[0],
        edge_offsets=edges[1],
        lane_id=scene.road_map.feature_id[lanes],
        lane_m=lane_m,
        lane_offsets=lane_offsets,
        signal_lane_id=lane_id,
        signal_state=state,
        signal_stop_m=stop_m,
        lights_recorded=scene.lights_recorded,
    )


def _features(
    scene: Scene, rows: np.ndarray
) -> tuple[Float32[np.ndarray, "point 3"], Int64[np.ndarray, " offset"]]:
    """World points of some map features, end to end, and where each starts."""
    points = [scene.road_map.points(row) for row in rows.tolist()]
    offsets = np.cumsum([0, *map(len, points)]).astype(np.int64)
    return world_xyz_m(
        scene, np.concatenate([np.zeros((0, 3), np.float32), *points])
    ), offsets


def _signals(
    scene: Scene,
) -> tuple[
    Int64[np.ndarray, " signal"],
    Int8[np.ndarray, "signal 91"],
    Float32[np.ndarray, "signal 91 2"],
]:
    """Signals as one row per lane and one column per step, zero where the log has none."""
    rows = np.flatnonzero(scene.signals.step < LOG_STEPS)
    lane_id, signal = np.unique(scene.signals.lane_id[rows], return_inverse=True)
    step = scene.signals.step[rows]
    state = np.zeros((len(lane_id), LOG_STEPS), dtype=np.int8)
    stop_m = np.zeros((len(lane_id), LOG_STEPS, 2), dtype=np.float32)
    state[signal, step] = scene.signals.state[rows]
    stop_m[signal, step] = world_xyz_m(scene, scene.signals.stop_xyz_m[rows])[:, :2]
    return lane_id, state, stop_m
