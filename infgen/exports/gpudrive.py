"""Rollouts as scenes of GPUDrive: one JSON file per rollout.

Facts of its format: coordinates are WOMD's, headings radians; all values of a step at which
an object is not there are -10000; a trajectory has at most 91 steps, later ones are not
read; the goal is where an object is last seen. ``map_element_id`` numbers WOMD's features.
Objects of interest are written as ``{"id": 7}``, which its loader reads (plain numbers stop
it), and a name has at most 31 letters.
"""

import json
from typing import Any

import numpy as np

from infgen.exports.features import (
    ANGLE_DECIMALS,
    Feature,
    agent_name,
    features_of,
    light_name,
    rounded,
)
from infgen.exports.states import NO_LIGHT, Lights, States, lights_of, states_of
from infgen.rollout.rollout import Rollout
from infgen.scene import FeatureType, Scene

STEPS = 91
"""Steps of a trajectory that are read."""
_GONE = -1e4
"""Value of everything that is not there."""
_FIRST_ELEMENT = {FeatureType.LANE: 0, FeatureType.ROAD_LINE: 5, FeatureType.ROAD_EDGE: 14}
_ELEMENTS = {
    FeatureType.STOP_SIGN: 17,
    FeatureType.CROSSWALK: 18,
    FeatureType.SPEED_BUMP: 19,
    FeatureType.DRIVEWAY: 20,
}


def map_text(scene: Scene) -> str:
    """Write the roads of a scene; the same for all of its rollouts."""
    return json.dumps([_road(feature) for feature in features_of(scene)])


def scene_text(rollout: Rollout, scene: Scene, name: str, roads: str, lights: str) -> str:
    """Write one rollout.

    Args:
        rollout: To write; its first 91 steps are.
        scene: That it continues.
        name: Of the file.
        roads: What ``map_text`` wrote of the scene.
        lights: What lights showed while it was played: ``now`` or ``log``.
    """
    states = states_of(rollout, scene, STEPS)
    head = {
        "name": name,
        "scenario_id": scene.scenario_id,
        "objects": [_object(states, row) for row in range(len(states.id))],
    }
    tail = {
        "tl_states": _lights(lights_of(scene, states.valid.shape[1], lights)),
        "metadata": _about(rollout, scene, states),
    }
    return f'{json.dumps(head)[:-1]}, "roads": {roads}, {json.dumps(tail)[1:]}\n'


def _object(states: States, row: int) -> dict[str, Any]:
    valid = states.valid[row]
    position = np.where(valid[:, None], states.xyz_m[row], _GONE)
    velocity = np.where(valid[:, None], states.velocity_mps[row], _GONE)
    heading = np.where(valid, states.heading_rad[row], _GONE)
    length, width, height = rounded(states.size_lwh_m[row])
    last = int(np.flatnonzero(valid)[-1])
    return {
        "position": _points(position),
        "width": width,
        "length": length,
        "height": height,
        "heading": rounded(heading, ANGLE_DECIMALS),
        "velocity": _points(velocity),
        "valid": valid.tolist(),
        "goalPosition": _points(position[last : last + 1])[0],
        "type": agent_name(int(states.agent_type[row])).lower(),
        "id": int(states.id[row]),
        "mark_as_expert": False,
    }


def _points(values: np.ndarray) -> list[dict[str, Any]]:
    """Name the axes of points [point, axis]."""
    axes = "xyz"[: values.shape[1]]
    return [dict(zip(axes, point, strict=True)) for point in np.round(values, 4).tolist()]


def _road(feature: Feature) -> dict[str, Any]:
    first = _FIRST_ELEMENT.get(feature.kind)
    element = _ELEMENTS[feature.kind] if first is None else first + feature.type
    return {
        "geometry": _points(feature.xyz_m),
        "type": feature.kind.name.lower(),
        "map_element_id": element,
        "id": feature.id,
    }


def _lights(lights: Lights) -> dict[str, dict[str, Any]]:
    found = {}
    stops = _points(lights.stop_xyz_m)
    for lane, state, place in zip(
        lights.lane_id.tolist(), lights.state, stops, strict=True
    ):
        shown = np.flatnonzero(state != NO_LIGHT)
        found[str(lane)] = {
            "state": [light_name(each).lower() for each in state[shown].tolist()],
            **{axis: [value] * len(shown) for axis, value in place.items()},
            "time_index": shown.tolist(),
        }
    return found


def _about(rollout: Rollout, scene: Scene, states: States) -> dict[str, Any]:
    """Roles of objects, by their place in the list or by id."""
    place = {track: row for row, track in enumerate(states.id.tolist())}
    wanted = zip(
        scene.tracks.id[scene.predict_row].tolist(),
        scene.predict_difficulty.tolist(),
        strict=True,
    )
    return {
        "sdc_track_index": place[int(rollout.id[rollout.ego])],
        "objects_of_interest": [
            {"id": track} for track in scene.interest_id.tolist() if track in place
        ],
        "tracks_to_predict": [
            {"track_index": place[track], "difficulty": level}
            for track, level in wanted
            if track in place
        ],
    }
