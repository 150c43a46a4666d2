"""The situation of a scene at "now": map, density and ego, as a few comparable numbers."""

import numpy as np
from jaxtyping import Float32

from infgen.clock import CLOCK
from infgen.metrics.traffic import Traffic
from infgen.scene import FeatureType, LinkType, RoadMap, Scene

STANDING_MPS = 0.5
"""Slower agents stand."""
MAP, DENSITY, EGO = "map", "density", "ego"
CONTEXT = (
    ("lane_km", MAP),
    ("branching_lanes", MAP),
    ("signalled_lanes", MAP),
    ("crosswalks", MAP),
    ("vehicles", DENSITY),
    ("pedestrians", DENSITY),
    ("cyclists", DENSITY),
    ("standing_share", DENSITY),
    ("mean_speed_mps", DENSITY),
    ("ego_speed_mps", EGO),
    ("ego_lane_distance_m", EGO),
)
"""Numbers and the groups that they belong to; a group weighs as much as any other."""
FAR_M = 10.0
"""The ego's distance to the nearest lane counts up to this."""


def read_context(
    scene: Scene, traffic: Traffic, radius_m: float
) -> Float32[np.ndarray, " context"]:
    """Describe the situation around the ego by ``CONTEXT``, from history and map alone.

    Numbers of things are square roots: 20 and 25 agents are as alike as 4 and 6.
    """
    motion, now, ego = traffic.motion, traffic.now, traffic.ego
    at_m = np.array([motion.x_m[0, ego, now], motion.y_m[0, ego, now]])
    away_m = np.hypot(motion.x_m[0, :, now] - at_m[0], motion.y_m[0, :, now] - at_m[1])
    near = motion.valid[0, :, now] & (away_m < radius_m)
    near[ego] = False
    speed_mps = _speeds_mps(traffic)
    around = speed_mps[near]
    counts = [float((motion.agent_type[near] == kind).sum()) for kind in range(3)]
    found = [
        *_map_numbers(scene, at_m, radius_m),
        *np.sqrt(counts),
        float((around < STANDING_MPS).mean()) if len(around) else 0.0,
        float(around.mean()) if len(around) else 0.0,
        float(speed_mps[ego]),
        _lane_distance_m(scene.road_map, at_m),
    ]
    return np.array(found, dtype=np.float32)


def _speeds_mps(traffic: Traffic) -> Float32[np.ndarray, " agent"]:
    """Speeds over the last token step up to now, or what of it is seen; else 0."""
    motion, now = traffic.motion, traffic.now
    steps = np.arange(max(0, now - CLOCK.steps_per_token), now + 1)
    first = steps[motion.valid[0][:, steps].argmax(axis=1)]
    rows = np.arange(motion.num_agents)
    moved_m = np.hypot(
        motion.x_m[0, :, now] - motion.x_m[0, rows, first],
        motion.y_m[0, :, now] - motion.y_m[0, rows, first],
    )
    seconds = (now - first) * CLOCK.step_s
    speed_mps = moved_m / np.where(seconds > 0, seconds, np.inf)
    return np.where(motion.valid[0, :, now], speed_mps, 0).astype(np.float32)


def _map_numbers(scene: Scene, at_m: np.ndarray, radius_m: float) -> list[float]:
    """Length of lanes, lanes that branch, signalled lanes and crosswalks near by."""
    road_map, feature = scene.road_map, _feature_of_points(scene.road_map)
    near = np.hypot(*(road_map.xyz_m[:, :2] - at_m).T) < radius_m
    step_m = np.zeros(len(near))
    step_m[1:] = np.hypot(*np.diff(road_map.xyz_m[:, :2], axis=0).T)
    step_m[road_map.point_offsets[:-1]] = 0  # From one feature to the next.
    lane = (road_map.feature_type == FeatureType.LANE)[feature]
    exits = road_map.link_lane_id[road_map.link_type == LinkType.EXIT]
    lanes, ways = np.unique(exits, return_counts=True)
    signalled = np.unique(scene.signals.lane_id[scene.signals.step <= scene.now])
    close = np.unique(feature[near])
    ids, kinds = road_map.feature_id[close], road_map.feature_type[close]
    return [
        float(step_m[near & lane].sum() / 1000),
        float(np.sqrt(np.isin(ids, lanes[ways > 1]).sum())),
        float(np.sqrt(np.isin(ids, signalled).sum())),
        float(np.sqrt((kinds == FeatureType.CROSSWALK).sum())),
    ]


def _lane_distance_m(road_map: RoadMap, at_m: np.ndarray) -> float:
    """Distance to the nearest point of a lane, at most ``FAR_M``."""
    lane = (road_map.feature_type == FeatureType.LANE)[_feature_of_points(road_map)]
    away_m = np.hypot(*(road_map.xyz_m[lane, :2] - at_m).T)
    return float(min(FAR_M, away_m.min(initial=FAR_M)))


def _feature_of_points(road_map: RoadMap) -> np.ndarray:
    return np.repeat(np.arange(road_map.num_features), np.diff(road_map.point_offsets))
