"""Rollouts as scenario descriptions of ScenarioNet and MetaDrive: a JSON file per rollout.

ScenarioNet keeps such descriptions as pickles, which run code when read, so rollouts are
not written so (``scenarionet_scene`` writes logs). The file holds the same dictionary with
lists for arrays; ``with_arrays``
makes it what MetaDrive takes, to be handed over in memory, or pickled by whoever wants to.

Facts of its format: coordinates are WOMD's; all state arrays are as long as the scenario;
what is not there is zero; ids are strings; lights are named by their lane.
"""

import json
from typing import Any

import numpy as np

from infgen.clock import CLOCK
from infgen.exports.features import (
    ANGLE_DECIMALS,
    Feature,
    agent_name,
    features_of,
    light_name,
    linked,
    rounded,
    womd_name,
)
from infgen.exports.states import NO_LIGHT, Lights, States, lights_of, states_of
from infgen.rollout.rollout import Rollout
from infgen.scene import FeatureType, LinkType, RoadMap, Scene, Side

VERSION = "infgen-1"
"""Of what is written here; ScenarioNet puts its own name and number."""
DATASET = "infgen"
_KMH_PER_MPH = 1.609344
LINES = (FeatureType.LANE, FeatureType.ROAD_LINE, FeatureType.ROAD_EDGE)
"""Features with a polyline."""
_ARRAYS = {
    **dict.fromkeys(("position", "length", "width", "height", "heading"), np.float32),
    **dict.fromkeys(("velocity", "polyline", "polygon", "stop_point", "ts"), np.float32),
    "valid": np.bool_,
}
"""Types of what are arrays in a description."""
_RENAMED = {"ROAD_LINE_UNKNOWN": "UNKNOWN_LINE", "ROAD_EDGE_UNKNOWN": "UNKNOWN"}


def map_text(scene: Scene) -> str:
    """Write the map of a scene; the same for all of its rollouts."""
    lanes = LaneRelations(scene.road_map)
    return json.dumps(
        {str(feature.id): _feature(feature, lanes) for feature in features_of(scene)}
    )


def scene_text(rollout: Rollout, scene: Scene, name: str, roads: str, lights: str) -> str:
    """Write one rollout, all of its steps.

    Args:
        rollout: To write.
        scene: That it continues.
        name: Id of the description.
        roads: What ``map_text`` wrote of the scene.
        lights: What lights showed while it was played: ``now`` or ``log``.
    """
    states = states_of(rollout, scene)
    head = {
        "id": name,
        "version": VERSION,
        "length": rollout.num_steps,
        "metadata": _about(rollout, scene, states, name),
        "tracks": {
            str(track): _track(states, row) for row, track in enumerate(states.id.tolist())
        },
        "dynamic_map_states": _lights(lights_of(scene, rollout.num_steps, lights)),
    }
    return f'{json.dumps(head)[:-1]}, "map_features": {roads}}}\n'


def with_arrays(part: Any) -> Any:
    """Turn the lists of a description, as JSON gave it, into the arrays they stand for."""
    if not isinstance(part, dict):
        return part
    return {
        name: np.array(value, _ARRAYS[name])
        if name in _ARRAYS and isinstance(value, list)
        else with_arrays(value)
        for name, value in part.items()
    }


def _track(states: States, row: int) -> dict[str, Any]:
    valid, agent_type = states.valid[row], agent_name(int(states.agent_type[row]))
    size_lwh_m = np.where(valid[:, None], states.size_lwh_m[row], np.float32(0))
    length, width, height = rounded(size_lwh_m.T)
    return {
        "type": agent_type,
        "state": {
            "position": rounded(states.xyz_m[row]),
            "length": length,
            "width": width,
            "height": height,
            "heading": rounded(states.heading_rad[row], ANGLE_DECIMALS),
            "velocity": rounded(states.velocity_mps[row]),
            "valid": valid.tolist(),
        },
        "metadata": object_metadata(agent_type, int(states.id[row]), len(valid)),
    }


def object_metadata(agent_type: str, number: int, num_steps: int) -> dict[str, Any]:
    """Metadata of a track or a light."""
    return {
        "type": agent_type,
        "object_id": str(number),
        "track_length": num_steps,
        "dataset": DATASET,
    }


def _lights(lights: Lights) -> dict[str, Any]:
    num_steps = lights.state.shape[1]
    return {
        str(lane): {
            "type": "TRAFFIC_LIGHT",
            "state": {
                "object_state": [
                    None if each == NO_LIGHT else f"LANE_STATE_{light_name(each)}"
                    for each in state.tolist()
                ]
            },
            "lane": lane,
            "stop_point": stop,
            "metadata": object_metadata("TRAFFIC_LIGHT", lane, num_steps),
        }
        for lane, state, stop in zip(
            lights.lane_id.tolist(), lights.state, rounded(lights.stop_xyz_m), strict=True
        )
    }


def _about(rollout: Rollout, scene: Scene, states: States, name: str) -> dict[str, Any]:
    kinds = dict(zip(states.id.tolist(), states.agent_type.tolist(), strict=True))
    wanted = zip(
        scene.tracks.id[scene.predict_row].tolist(),
        scene.predict_difficulty.tolist(),
        strict=True,
    )
    places = {track: row for row, track in enumerate(kinds)}
    return {
        "id": name,
        "coordinate": "waymo",
        "ts": rounded(CLOCK.step_s * np.arange(rollout.num_steps)),
        "metadrive_processed": False,
        "sdc_id": str(rollout.id[rollout.ego]),
        "sdc_track_index": places[int(rollout.id[rollout.ego])],
        "dataset": DATASET,
        "scenario_id": scene.scenario_id,
        "source_file": "",
        "track_length": rollout.num_steps,
        "current_time_index": scene.now,
        "objects_of_interest": [
            str(track) for track in scene.interest_id.tolist() if track in kinds
        ],
        "tracks_to_predict": {
            str(track): {
                "track_index": places[track],
                "track_id": str(track),
                "difficulty": level,
                "object_type": agent_name(kinds[track]),
            }
            for track, level in wanted
            if track in kinds
        },
        "rollout": rollout.index,
        "seed": str(rollout.seed),
        "weights": rollout.weights,
    }


_SPAN = (
    "self_start_index",
    "self_end_index",
    "neighbor_start_index",
    "neighbor_end_index",
)


class LaneRelations:
    """What lanes lead to and lie beside, by their ids."""

    def __init__(self, road_map: RoadMap) -> None:
        self.map = road_map
        self.before = linked(road_map, LinkType.ENTRY)
        self.after = linked(road_map, LinkType.EXIT)

    def neighbours(self, lane: int, side: Side) -> list[dict[str, Any]]:
        """Lanes on one side, with the stretches along which they are."""
        found = self.map
        rows = (found.neighbour_lane_id == lane) & (found.neighbour_side == side)
        return [
            {
                "feature_id": str(found.neighbour_other_id[row]),
                **dict(zip(_SPAN, map(str, found.neighbour_span[row]), strict=True)),
                "boundaries": self._bounds(found.boundary_neighbour == row),
            }
            for row in np.flatnonzero(rows)
        ]

    def boundaries(self, lane: int, side: Side) -> list[dict[str, Any]]:
        """Features that bound a lane on one side."""
        found = self.map
        own = (found.boundary_neighbour < 0) & (found.boundary_lane_id == lane)
        return self._bounds(own & (found.boundary_side == side))

    def _bounds(self, rows: np.ndarray) -> list[dict[str, Any]]:
        found = self.map
        return [
            {
                "lane_start_index": str(found.boundary_span[row, 0]),
                "lane_end_index": str(found.boundary_span[row, 1]),
                "boundary_type": _line_name(int(found.boundary_type[row])),
                "boundary_feature_id": str(found.boundary_feature_id[row]),
            }
            for row in np.flatnonzero(rows)
        ]


def _line_name(kind: int) -> str:
    nowhere = np.zeros((0, 3))
    return feature_type_name(Feature(0, 0, FeatureType.ROAD_LINE, kind, nowhere))


def feature_type_name(feature: Feature) -> str:
    """Name a feature's sub-type as MetaDrive does."""
    name = womd_name(feature)
    return _RENAMED.get(name, name)


def _feature(feature: Feature, lanes: LaneRelations) -> dict[str, Any]:
    found: dict[str, Any] = {"type": feature_type_name(feature)}
    points = rounded(feature.xyz_m)
    if feature.kind == FeatureType.STOP_SIGN:
        signs = lanes.map.sign_id == feature.id
        return found | {
            "lane": lanes.map.sign_lane_id[signs].tolist(),
            "position": points[0],
        }
    if feature.kind not in LINES:
        return found | {"polygon": points}
    if feature.kind == FeatureType.LANE:
        found |= lane_fields(feature, lanes)
    return found | {"polyline": points}


def lane_fields(feature: Feature, lanes: LaneRelations) -> dict[str, Any]:
    """Speed limit and relations of a lane."""
    speed_mph = float(lanes.map.speed_limit_mph[feature.row])
    return {
        "speed_limit_mph": speed_mph,
        "speed_limit_kmh": round(speed_mph * _KMH_PER_MPH, 4),
        "interpolating": bool(lanes.map.interpolating[feature.row]),
        "entry_lanes": lanes.before.get(feature.id, []),
        "exit_lanes": lanes.after.get(feature.id, []),
        "left_boundaries": lanes.boundaries(feature.id, Side.LEFT),
        "right_boundaries": lanes.boundaries(feature.id, Side.RIGHT),
        "left_neighbor": lanes.neighbours(feature.id, Side.LEFT),
        "right_neighbor": lanes.neighbours(feature.id, Side.RIGHT),
    }
