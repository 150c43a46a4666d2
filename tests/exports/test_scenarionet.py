import json

import numpy as np
import pytest

from infgen.exports import scenarionet
from infgen.scene import SignalState
from tests.exports.replays import decoded_small, replay, with_newcomer

FIRST_LEVEL = {"id", "version", "length", "metadata", "tracks", "dynamic_map_states"}


def describe(rollout, scene, lights="now"):
    roads = scenarionet.map_text(scene)
    text = scenarionet.scene_text(rollout, scene, "a_000", roads, lights)
    return scenarionet.with_arrays(json.loads(text))


@pytest.fixture
def written(crossing, build_signals):
    rows = [(step, 1, SignalState.GO) for step in range(5, 11)]
    scene = crossing(signals=build_signals(rows))
    return describe(with_newcomer(replay(scene), 40), scene)


def test_a_description_has_all_keys_of_the_first_level(written):
    assert set(written) == FIRST_LEVEL | {"map_features"}
    assert written["length"] == 91
    assert {"ts", "coordinate", "metadrive_processed", "sdc_id"} <= set(written["metadata"])
    assert written["metadata"]["ts"].shape == (91,)


def test_every_state_is_an_array_as_long_as_the_scenario(written):
    """What ScenarioNet's own sanity check asks of tracks and lights."""
    for name, each in (written["tracks"] | written["dynamic_map_states"]).items():
        assert {"type", "state", "metadata"} <= set(each)
        assert each["metadata"]["object_id"] == name
        for values in each["state"].values():
            assert len(values) == 91
    for track in written["tracks"].values():
        state = track["state"]
        assert state["position"].shape == (91, 3)
        assert state["valid"].dtype == bool
        assert state["valid"].any()
        for values in state.values():
            assert not values[~state["valid"]].any()


def test_tracks_are_where_the_rollout_has_them(written):
    ego = written["tracks"][written["metadata"]["sdc_id"]]

    assert ego["type"] == "VEHICLE"
    assert ego["state"]["position"][20] == pytest.approx([980, -2000, 10.8], abs=1e-3)
    assert ego["state"]["velocity"][20] == pytest.approx([10, 0])
    assert written["tracks"]["103"]["type"] == "CYCLIST"
    assert written["tracks"]["104"]["state"]["valid"].tolist() == [
        s > 40 for s in range(91)
    ]


def test_lights_are_named_by_their_lane_and_unknown_where_the_log_is(written):
    light = written["dynamic_map_states"]["1"]

    assert light["type"] == "TRAFFIC_LIGHT"
    assert light["lane"] == 1
    assert light["state"]["object_state"] == [None] * 5 + ["LANE_STATE_GO"] * 86


def test_lights_change_as_they_did_while_it_was_played(crossing, build_signals):
    rows = [(step, 1, SignalState.STOP) for step in range(60)]
    rows += [(step, 1, SignalState.GO) for step in range(60, 91)]
    scene = crossing(signals=build_signals(rows))

    def shown(lights):
        found = describe(replay(scene), scene, lights)["dynamic_map_states"]["1"]
        return found["state"]["object_state"]

    assert shown("now") == ["LANE_STATE_STOP"] * 91
    assert shown("log") == ["LANE_STATE_STOP"] * 60 + ["LANE_STATE_GO"] * 31


def test_the_map_has_lines_outlines_and_the_relations_of_lanes():
    scene = decoded_small()
    features = describe(replay(scene), scene)["map_features"]
    kinds = {feature["type"] for feature in features.values()}

    assert {"STOP_SIGN", "CROSSWALK", "SPEED_BUMP", "DRIVEWAY"} <= kinds
    lane = features["100"]
    assert lane["polyline"].shape[1] == 3
    assert lane["speed_limit_kmh"] == pytest.approx(lane["speed_limit_mph"] * 1.609344)
    own = scene.road_map
    assert len(lane["entry_lanes"] + lane["exit_lanes"]) == len(own.link_lane_id)
    beside = lane["left_neighbor"] + lane["right_neighbor"]
    assert len(beside) == len(own.neighbour_lane_id)
    bounds = lane["left_boundaries"] + lane["right_boundaries"]
    bounds += [bound for each in beside for bound in each["boundaries"]]
    assert len(bounds) == len(own.boundary_lane_id)
    sign = next(f for f in features.values() if f["type"] == "STOP_SIGN")
    assert sign["position"].shape == (3,)
    assert sign["lane"] == own.sign_lane_id.tolist()


def test_roles_are_told_by_id():
    scene = decoded_small()
    about = describe(replay(scene), scene)["metadata"]

    assert about["objects_of_interest"] == ["9", "7"]
    assert about["tracks_to_predict"]["9"]["difficulty"] == 2
    assert about["tracks_to_predict"]["9"]["object_type"] == "PEDESTRIAN"


def test_arrays_come_back_exactly_as_written():
    found = scenarionet.with_arrays(
        {
            "position": [[0.0, 1.5]],
            "valid": [False],
            "length": 3,
            "lane": [1],
            "b": {"ts": []},
        }
    )

    assert found["position"].dtype == np.float32
    assert found["valid"].dtype == bool
    assert (found["length"], found["lane"]) == (3, [1])
    assert found["b"]["ts"].shape == (0,)
