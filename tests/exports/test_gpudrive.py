import json

import pytest

from infgen.exports import gpudrive
from infgen.scene import SignalState
from tests.exports.replays import decoded_small, replay, with_newcomer


@pytest.fixture
def scene(crossing, build_signals):
    return crossing(
        steps=140,
        signals=build_signals([(s, 1, SignalState.ARROW_STOP) for s in range(140)]),
    )


@pytest.fixture
def written(scene):
    rollout = with_newcomer(replay(scene), 40)
    text = gpudrive.scene_text(rollout, scene, "a_000", gpudrive.map_text(scene), "now")
    return json.loads(text)


def test_a_scene_has_the_keys_that_the_loader_reads(written):
    assert list(written) == [
        *("name", "scenario_id", "objects", "roads", "tl_states", "metadata")
    ]
    assert written["name"] == "a_000"
    needed = {"position", "width", "length", "height", "heading", "velocity", "valid"}
    needed |= {"goalPosition", "type", "id", "mark_as_expert"}
    for each in written["objects"]:
        assert set(each) == needed
        lengths = {len(each[name]) for name in ("position", "heading", "velocity", "valid")}
        assert lengths == {91}


def test_objects_are_where_the_rollout_has_them(written):
    ego = written["objects"][0]

    assert [each["type"] for each in written["objects"]] == [
        *("vehicle", "vehicle", "cyclist", "vehicle")
    ]
    assert ego["position"][20] == {"x": 980.0, "y": -2000.0, "z": 10.8}
    assert ego["velocity"][20] == {"x": 10.0, "y": 0.0}
    assert written["objects"][1]["heading"][20] == pytest.approx(1.570796)
    assert ego["goalPosition"] == {"x": 1050.0, "y": -2000.0, "z": 10.8}
    assert (ego["length"], ego["width"], ego["height"]) == (4.8, 2.0, 1.6)


def test_who_is_not_there_is_far_away_and_not_valid(written):
    newcomer = written["objects"][3]

    assert newcomer["valid"] == [step > 40 for step in range(91)]
    assert newcomer["position"][40] == {"x": -10000.0, "y": -10000.0, "z": -10000.0}
    assert newcomer["heading"][40] == newcomer["velocity"][40]["x"] == -10000.0


def test_roads_carry_their_points_and_element_numbers(written):
    kinds = {
        road["id"]: (road["type"], road["map_element_id"]) for road in written["roads"]
    }

    assert kinds == {1: ("lane", 2), 2: ("road_edge", 15), 3: ("crosswalk", 18)}
    assert written["roads"][0]["geometry"][0] == {"x": 900.0, "y": -2000.0, "z": 10.0}


def test_every_kind_of_feature_has_a_type_and_a_number():
    scene = decoded_small()

    roads = json.loads(gpudrive.map_text(scene))

    types = {road["type"] for road in roads}
    assert types == {
        *("lane", "road_line", "road_edge", "stop_sign"),
        *("crosswalk", "speed_bump", "driveway"),
    }
    assert all(0 <= road["map_element_id"] <= 20 for road in roads)


def test_lights_and_roles_are_told(written):
    light = written["tl_states"]["1"]

    assert light["state"] == ["arrow_stop"] * 91
    assert light["time_index"] == list(range(91))
    assert written["metadata"] == {
        "sdc_track_index": 0,
        "objects_of_interest": [],
        "tracks_to_predict": [{"track_index": 0, "difficulty": 0}],
    }


def test_lights_change_as_they_did_while_it_was_played(crossing, build_signals):
    states = [SignalState.STOP] * 60 + [SignalState.GO] * 80
    rows = [(step, 1, state) for step, state in enumerate(states)]
    scene = crossing(steps=140, signals=build_signals(rows))
    rollout = replay(scene)

    def written(lights):
        text = gpudrive.scene_text(rollout, scene, "a", gpudrive.map_text(scene), lights)
        return json.loads(text)["tl_states"]["1"]["state"]

    assert written("now") == ["stop"] * 91
    assert written("log") == ["stop"] * 60 + ["go"] * 31


def test_roles_are_places_in_the_list_and_ids():
    scene = decoded_small()
    roads = gpudrive.map_text(scene)
    text = gpudrive.scene_text(replay(scene), scene, "n", roads, "now")

    assert json.loads(text)["metadata"] == {
        "sdc_track_index": 0,
        "objects_of_interest": [{"id": 9}, {"id": 7}],
        "tracks_to_predict": [{"track_index": 1, "difficulty": 2}],
    }
