"""Logs as scene files of ScenarioNet and MetaDrive.

Inverse of ``infgen.sources.scenarionet``. Nothing is rounded: positions are float64 in the
world frame, so that the same ``Scene`` comes back. A light's rows are named by its lane;
where the order of lanes within a step is not theirs, or a stop point moves, that stands
among the light's states.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.exports.features import Feature, agent_name, light_name
from infgen.exports.scenarionet import (
    DATASET,
    LINES,
    VERSION,
    LaneRelations,
    feature_type_name,
    lane_fields,
    object_metadata,
)
from infgen.scene import FeatureType, Scene, Signals
from infgen.sources.scenarionet import LIGHTS_RECORDED, ORIGIN
from infgen.sources.scenarionet.pickles import pickled
from infgen.sources.scenarionet.signals import RANK, STOP_POINTS


class NotWritableError(ValueError):
    """A scene that ScenarioNet's format cannot hold."""


def write_scene(path: Path, scene: Scene, split: str) -> None:
    """Write one log as a scene file.

    Raises:
        NotWritableError: if a lane has two lights in one step.
    """
    path.write_bytes(pickled(describe_scene(scene, split)))


def describe_scene(scene: Scene, split: str = "") -> dict[str, Any]:
    """Describe one log as ScenarioNet does.

    Args:
        scene: The log.
        split: ``training``, ``validation`` or ``testing``; empty for none.

    Raises:
        NotWritableError: if a lane has two lights in one step.
    """
    return {
        "id": scene.scenario_id,
        "version": VERSION,
        "length": scene.tracks.num_steps,
        "metadata": _metadata(scene, split),
        "tracks": {
            str(track): _track(scene, row)
            for row, track in enumerate(scene.tracks.id.tolist())
        },
        "dynamic_map_states": _lights(scene),
        "map_features": _features(scene),
    }


def _metadata(scene: Scene, split: str) -> dict[str, Any]:
    ids = scene.tracks.id.tolist()
    wanted = zip(scene.predict_row.tolist(), scene.predict_difficulty.tolist(), strict=True)
    return {
        "id": scene.scenario_id,
        "scenario_id": scene.scenario_id,
        "dataset": DATASET,
        **({"split": split} if split else {}),
        "coordinate": "waymo",
        "metadrive_processed": False,
        "ts": scene.timestamps_s,
        "track_length": scene.tracks.num_steps,
        "current_time_index": scene.now,
        "sdc_id": str(ids[scene.ego]),
        "sdc_track_index": scene.ego,
        "objects_of_interest": [str(track) for track in scene.interest_id.tolist()],
        "tracks_to_predict": {
            str(ids[row]): {
                "track_index": row,
                "track_id": str(ids[row]),
                "difficulty": level,
                "object_type": agent_name(int(scene.tracks.agent_type[row])),
            }
            for row, level in wanted
        },
        ORIGIN: scene.origin_xyz_m,
        **({} if scene.lights_recorded else {LIGHTS_RECORDED: False}),
    }


def _track(scene: Scene, row: int) -> dict[str, Any]:
    tracks = scene.tracks
    kind = agent_name(int(tracks.agent_type[row]))
    return {
        "type": kind,
        "state": {
            "position": tracks.xyz_m[row].astype(np.float64) + scene.origin_xyz_m,
            "length": tracks.size_lwh_m[row, :, 0],
            "width": tracks.size_lwh_m[row, :, 1],
            "height": tracks.size_lwh_m[row, :, 2],
            "heading": tracks.heading_rad[row],
            "velocity": tracks.velocity_mps[row],
            "valid": tracks.valid[row],
        },
        "metadata": object_metadata(kind, int(tracks.id[row]), tracks.num_steps),
    }


def _lights(scene: Scene) -> dict[str, Any]:
    signals, num_steps = scene.signals, scene.tracks.num_steps
    lanes = list(dict.fromkeys(signals.lane_id.tolist()))
    first = np.searchsorted(signals.step, signals.step)
    rank = np.arange(len(signals.step)) - first
    found = {}
    for place, lane in enumerate(lanes):
        rows = np.flatnonzero(signals.lane_id == lane)
        steps = signals.step[rows]
        if len(np.unique(steps)) < len(steps):
            raise NotWritableError(f"lane {lane} has two lights in one step")
        stops_m = signals.stop_xyz_m[rows].astype(np.float64) + scene.origin_xyz_m
        state: dict[str, Any] = {"object_state": _shown(signals, rows, num_steps)}
        if (stops_m != stops_m[0]).any():
            state[STOP_POINTS] = np.tile(stops_m[0], (num_steps, 1))
            state[STOP_POINTS][steps] = stops_m
        ranks = np.full(num_steps, place)
        ranks[steps] = rank[rows]
        state[RANK] = ranks
        found[str(lane)] = {
            "type": "TRAFFIC_LIGHT",
            "state": state,
            "lane": lane,
            "stop_point": stops_m[0],
            "metadata": object_metadata("TRAFFIC_LIGHT", lane, num_steps),
        }
    return found


def _shown(signals: Signals, rows: np.ndarray, num_steps: int) -> list[str | None]:
    shown: list[str | None] = [None] * num_steps
    states = zip(signals.step[rows].tolist(), signals.state[rows].tolist(), strict=True)
    for step, state in states:
        shown[step] = f"LANE_STATE_{light_name(state)}"
    return shown


def _features(scene: Scene) -> dict[str, Any]:
    road_map, found = scene.road_map, {}
    lanes = LaneRelations(road_map)
    for row in range(road_map.num_features):
        points_m = road_map.points(row).astype(np.float64) + scene.origin_xyz_m
        feature = Feature(
            row,
            int(road_map.feature_id[row]),
            FeatureType(road_map.feature_type[row]),
            int(road_map.feature_subtype[row]),
            points_m,
        )
        found[str(feature.id)] = _feature(feature, lanes, points_m)
    return found


def _feature(
    feature: Feature, lanes: LaneRelations, points_m: Float64[np.ndarray, "point 3"]
) -> dict[str, Any]:
    found: dict[str, Any] = {"type": feature_type_name(feature)}
    if feature.kind == FeatureType.STOP_SIGN:
        signs = lanes.map.sign_id == feature.id
        found["lane"] = lanes.map.sign_lane_id[signs].tolist()
        return found | ({"position": points_m[0]} if len(points_m) else {})
    if feature.kind not in LINES:
        return found | {"polygon": points_m}
    if feature.kind == FeatureType.LANE:
        found |= lane_fields(feature, lanes)
    return found | {"polyline": points_m}
