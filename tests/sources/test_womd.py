import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.scene import (
    AgentType,
    FeatureType,
    LinkType,
    Scene,
    Side,
    SignalState,
    world_xyz_m,
)
from infgen.sources import wire
from infgen.sources.tfrecord import BadRecord, RecordError
from infgen.sources.womd import decode_scene, iter_scenes
from tests.sources.oracle import expected_scene
from tests.sources.records import NOW, STEPS, changed, small_scenario, write_tfrecord
from tests.sources.scenario_proto import Scenario
from tests.sources.test_wire import field_bytes

NOTHING = b""


def differences(found, expected, name="scene") -> list[str]:
    """Fields of two records that are not equal bit for bit."""
    if dataclasses.is_dataclass(found):
        return [
            line
            for field in dataclasses.fields(found)
            for line in differences(
                getattr(found, field.name),
                getattr(expected, field.name),
                f"{name}.{field.name}",
            )
        ]
    if isinstance(found, np.ndarray):
        alike = found.dtype == expected.dtype and found.shape == expected.shape
        return [] if alike and found.tobytes() == expected.tobytes() else [name]
    return [] if found == expected else [name]


def scene_of(change=lambda message: None) -> Scene:
    return decode_scene(changed(change))


def test_a_small_record_is_read_as_protobuf_reads_it():
    assert differences(scene_of(), expected_scene(small_scenario())) == []


def test_the_origin_is_whole_metres_near_the_ego_now():
    scene = scene_of()

    # The ego now is at (1000.5, -2000.25, 30.125); halves go to the even metre.
    assert scene.origin_xyz_m.tolist() == [1000.0, -2000.0, 30.0]
    np.testing.assert_array_equal(scene.tracks.xyz_m[0, NOW], [0.5, -0.25, 0.125])


def test_tracks_keep_ids_kinds_sizes_and_roles():
    scene = scene_of()

    assert scene.tracks.id.tolist() == [7, 9]
    assert scene.tracks.agent_type.tolist() == [AgentType.VEHICLE, AgentType.PEDESTRIAN]
    assert scene.tracks.size_lwh_m[0, 0].tolist() == [4.5, 2.0, 1.5]
    assert scene.tracks.valid[1].tolist() == [False, False] + [True] * (STEPS - 2)
    assert (scene.ego, scene.now, scene.tracks.num_steps) == (0, NOW, STEPS)
    assert (scene.predict_row.tolist(), scene.predict_difficulty.tolist()) == ([1], [2])
    assert scene.interest_id.tolist() == [9, 7]


def test_the_map_keeps_kinds_points_and_relations():
    road_map = scene_of().road_map

    assert road_map.feature_id.tolist() == [100, 101, 300, 301, 400, 500, 600, 700]
    assert road_map.feature_type.tolist() == [3, 3, 4, 5, 7, 8, 9, 10]
    assert road_map.feature_subtype.tolist() == [2, 3, 7, 1, 0, 0, 0, 0]
    assert np.diff(road_map.point_offsets).tolist() == [3, 4, 4, 5, 1, 4, 4, 4]
    assert road_map.speed_limit_mph.tolist() == [25, 25, 0, 0, 0, 0, 0, 0]
    assert road_map.points(4).tolist() == [[5.0, 1.0, 1.0]]
    links = zip(road_map.link_type, road_map.link_other_id, strict=True)
    entry, leave = LinkType.ENTRY, LinkType.EXIT
    assert [*links] == [(entry, 98), (entry, 99), (leave, 200)]
    assert road_map.neighbour_span.tolist() == [[0, 2, 1, 3]]
    assert road_map.boundary_side.tolist() == [Side.LEFT, Side.RIGHT]
    assert road_map.boundary_neighbour.tolist() == [0, -1]
    assert road_map.boundary_span.tolist() == [[0, 1], [1, 2]]
    assert road_map.sign_lane_id.tolist() == [100, 101]


def test_signals_are_rows_of_step_and_lane():
    signals = scene_of().signals

    assert signals.step.tolist() == list(range(STEPS))
    assert set(signals.lane_id.tolist()) == {100}
    assert set(signals.state.tolist()) == {SignalState.STOP}
    np.testing.assert_array_equal(signals.stop_xyz_m[0], [10, 0, 0])


def test_world_zero_comes_back_exactly_at_invalid_steps():
    scene = scene_of()

    world_m = world_xyz_m(scene, scene.tracks.xyz_m)

    assert world_m.dtype == np.float32
    np.testing.assert_array_equal(world_m[1, :2], np.zeros((2, 3)))
    np.testing.assert_array_equal(world_m[0, NOW], np.float32([1000.5, -2000.25, 30.125]))


@given(
    xyz=st.tuples(*[st.floats(-5000, 5000, allow_nan=False)] * 3),
    origin=st.tuples(*[st.integers(-5000, 5000)] * 3),
)
def test_world_positions_equal_the_record_to_half_a_local_ulp(xyz, origin):
    scene = dataclasses.replace(scene_of(), origin_xyz_m=np.array(origin, np.float64))
    local_m = (np.array(xyz) - scene.origin_xyz_m).astype(np.float32)

    world_m = world_xyz_m(scene, local_m)

    bound = np.spacing(np.float32(np.abs(xyz))) + np.spacing(np.abs(local_m))
    assert (np.abs(world_m.astype(np.float64) - xyz) <= bound).all()


def test_values_that_are_not_finite_become_the_records_zero_where_invalid():
    def change(message):
        state = message.tracks[1].states[0]
        state.center_x, state.center_y, state.center_z = math.nan, math.inf, 5.0
        state.heading, state.length = -math.inf, math.nan

    scene = scene_of(change)

    assert world_xyz_m(scene, scene.tracks.xyz_m)[1, 0].tolist() == [0, 0, 5]
    assert scene.tracks.heading_rad[1, 0] == 0
    assert scene.tracks.size_lwh_m[1, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("steps", [11, 91, 198])
def test_records_of_any_length_are_read(steps):
    scene = decode_scene(small_scenario(steps=steps).SerializeToString())

    assert scene.tracks.num_steps == len(scene.timestamps_s) == steps


def test_unset_and_unknown_kinds_of_agents_are_other():
    def change(message):
        message.tracks[0].ClearField("object_type")
        message.tracks[1].object_type = 77

    assert scene_of(change).tracks.agent_type.tolist() == [AgentType.OTHER] * 2


def test_unknown_enum_values_are_unset():
    def change(message):
        message.map_features[0].lane.type = 99
        message.map_features[2].road_line.type = -1
        message.dynamic_map_states[0].lane_states[0].state = 50
        message.tracks_to_predict[0].difficulty = 9

    scene = scene_of(change)

    assert scene.road_map.feature_subtype[[0, 2]].tolist() == [0, 0]
    assert scene.signals.state[0] == SignalState.UNKNOWN
    assert scene.predict_difficulty.tolist() == [0]


def test_features_of_unknown_kinds_are_passed_over():
    data = changed(lambda message: None)
    feature = field_bytes(1, 0, 999) + field_bytes(15, 2, b"\x08\x01")

    scene = decode_scene(data + field_bytes(8, 2, feature))

    assert 999 not in scene.road_map.feature_id


def test_single_point_lines_are_real_and_kept():
    def change(message):
        del message.map_features[0].lane.polyline[1:]

    assert np.diff(scene_of(change).road_map.point_offsets)[0] == 1


def test_a_record_without_map_and_lights_is_a_scene():
    def change(message):
        del message.map_features[:]
        del message.dynamic_map_states[:]

    scene = scene_of(change)

    assert scene.road_map.num_features == 0
    assert scene.road_map.point_offsets.tolist() == [0]
    assert len(scene.signals.step) == 0


def test_a_stop_sign_without_position_has_no_points():
    def change(message):
        message.map_features[4].stop_sign.ClearField("position")

    road_map = scene_of(change).road_map

    assert len(road_map.points(4)) == 0
    assert road_map.feature_type[4] == FeatureType.STOP_SIGN


def test_packed_and_single_timestamps_and_lanes_are_read_alike():
    message = small_scenario()
    times = np.array(message.timestamps_seconds, "<f8").tobytes()
    del message.timestamps_seconds[:]
    packed = field_bytes(1, 2, times) + message.SerializeToString()

    assert differences(decode_scene(packed), scene_of()) == []


def nan_position(message):
    message.tracks[0].states[3].center_y = math.nan


def infinite_heading(message):
    message.tracks[0].states[3].heading = math.inf


def overflowing_position(message):
    message.tracks[0].states[3].center_x = 1e200


def nan_size(message):
    message.tracks[1].states[5].width = math.nan


def infinite_velocity(message):
    message.tracks[1].states[5].velocity_y = -math.inf


def nan_point(message):
    message.map_features[5].crosswalk.polygon[2].z = math.nan


def nan_stop_point(message):
    message.dynamic_map_states[2].lane_states[0].stop_point.x = math.nan


def nan_time(message):
    message.timestamps_seconds[3] = math.nan


def flat_line(message):
    for point in message.map_features[3].road_edge.polyline:
        point.x, point.y, point.z = 1.0, 2.0, 3.0


def empty_lane(message):
    del message.map_features[1].lane.polyline[:]


def twin_tracks(message):
    message.tracks[1].id = 7


def twin_features(message):
    message.map_features[2].id = 301


def short_track(message):
    del message.tracks[1].states[-1]


def short_lights(message):
    del message.dynamic_map_states[-1]


def ego_gone_now(message):
    message.tracks[0].states[NOW].valid = False


def ego_lost(message):
    message.tracks[0].states[NOW].center_x = math.nan


def setter(**values):
    def change(message):
        for name, value in values.items():
            setattr(message, name, value)

    return change


def clearer(name):
    return lambda message: message.ClearField(name)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (clearer("sdc_track_index"), "record has no ego: sdc_track_index is missing"),
        (setter(sdc_track_index=2), "ego row 2 is not one of the 2 tracks"),
        (setter(sdc_track_index=-1), "ego row -1 is not one of the 2 tracks"),
        (ego_gone_now, "ego (track 7) is not valid at step 4"),
        (ego_lost, "ego stands at [nan, -2000.25, 30.125] m: not finite or too far out"),
        (setter(current_time_index=12), "current step 12 is not one of the 12 steps"),
        (setter(current_time_index=-1), "current step -1 is not one of the 12 steps"),
        (setter(scenario_id=""), "scenario id is empty"),
        (clearer("scenario_id"), "scenario id is empty"),
        (clearer("tracks"), "record has no tracks"),
        (clearer("timestamps_seconds"), "record has 0 timestamps; expected 1 to 32767"),
        (short_track, "track 9 has 11 states for 12 timestamps"),
        (short_lights, "11 dynamic map states for 12 timestamps"),
        (twin_tracks, "two tracks have id 7"),
        (twin_features, "two map features have id 301"),
        (nan_position, "track 7 has a position that is not finite at step 3"),
        (overflowing_position, "track 7 has a position that is not finite at step 3"),
        (infinite_heading, "track 7 has a heading that is not finite at step 3"),
        (nan_size, "track 9 has a size that is not finite at step 5"),
        (infinite_velocity, "track 9 has a velocity that is not finite at step 5"),
        (nan_point, "map feature 500 has a point that is not finite"),
        (nan_stop_point, "a signal has a stop point that is not finite"),
        (nan_time, "a timestamp is not finite"),
        (flat_line, "polyline 301 has zero length"),
        (empty_lane, "polyline 101 has no points"),
        (
            lambda message: message.tracks_to_predict.add(track_index=2),
            "track to predict 2 is not one of the 2 tracks",
        ),
        (
            lambda message: message.tracks_to_predict.add(track_index=-3),
            "track to predict -3 is not one of the 2 tracks",
        ),
    ],
)
def test_records_that_are_no_scene_are_refused_with_the_reason(change, reason):
    with pytest.raises(RecordError) as error:
        scene_of(change)

    assert str(error.value) == reason


SOUND = changed(lambda message: None)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (NOTHING, "record is empty"),
        (SOUND[:-1], "not a usable Scenario message: "),
        (b"\xff" * 50, "not a usable Scenario message: "),
        (SOUND + field_bytes(5, 2, b"\xff\xfe"), "is not UTF-8"),
        (field_bytes(5, 2, b"id") + field_bytes(12, 2, b"x"), "only lidar or camera data"),
        (SOUND + field_bytes(8, 2, b"\x1a\x00\x22\x00"), "is of two kinds"),
        (
            SOUND + field_bytes(8, 2, b"\x08\x0b" + field_bytes(7, 2, b"\x12\x00\x12\x00")),
            "stop sign 11 has two positions",
        ),
    ],
)
def test_bytes_that_are_no_scenario_are_refused_with_the_reason(data, words):
    with pytest.raises(RecordError, match=words):
        decode_scene(data)


def test_a_tf_example_is_named():
    feature = field_bytes(1, 2, b"state/x") + field_bytes(2, 2, b"\x12\x00")
    example = field_bytes(1, 2, field_bytes(1, 2, feature) * 3)

    with pytest.raises(RecordError, match=r"holds a tf\.Example, not a Scenario"):
        decode_scene(example)


def test_a_file_gives_scenes_and_bad_records_in_order(tmp_path):
    good, bad = SOUND, changed(twin_tracks, "bad")
    path = write_tfrecord(tmp_path / "training.tfrecord.gz", [good, bad, good])

    found = list(iter_scenes(path))

    assert [type(item) for item in found] == [Scene, BadRecord, Scene]
    assert found[1] == BadRecord(1, len(good) + 16, "two tracks have id 7")


def shuffled(message, order) -> bytes:
    """Serialise a message with its top-level fields in another order."""
    parts = []
    for descriptor, _ in message.ListFields():
        part = Scenario()
        if descriptor.is_repeated:
            getattr(part, descriptor.name).MergeFrom(getattr(message, descriptor.name))
        else:
            setattr(part, descriptor.name, getattr(message, descriptor.name))
        parts.append(part.SerializeToString())
    return b"".join(parts[i] for i in order.permutation(len(parts)))


@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_fields_does_not_matter(seed):
    data = shuffled(small_scenario(), np.random.default_rng(seed))

    assert differences(decode_scene(data), scene_of()) == []


INT32, INT64 = st.integers(-(2**31), 2**31 - 1), st.integers(-(2**63), 2**63 - 1)
COORDINATES = st.floats(-1e5, 1e5)


def draw_relations(draw, lane):
    lane.interpolating = draw(st.booleans())
    lane.entry_lanes.extend(draw(st.lists(INT64, max_size=3)))
    for side in (lane.left_neighbors, lane.right_neighbors):
        for span in draw(st.lists(st.tuples(INT64, INT32, INT32), max_size=3)):
            added = side.add(
                feature_id=span[0], self_start_index=span[1], self_end_index=span[2]
            )
            for kind in draw(st.lists(st.integers(0, 8), max_size=3)):
                added.boundaries.add(boundary_type=kind, lane_end_index=span[1])
    for span in draw(st.lists(st.tuples(INT64, INT32), max_size=3)):
        lane.left_boundaries.add(boundary_feature_id=span[0], lane_start_index=span[1])


@st.composite
def scenarios(draw):
    """Sound messages whose free values are anything their fields can hold."""
    message = small_scenario(draw(st.text(min_size=1, max_size=9)))
    message.objects_of_interest.extend(draw(st.lists(INT32, max_size=3)))
    for track in message.tracks:
        for state in draw(st.lists(st.sampled_from(list(track.states)), max_size=4)):
            state.heading = draw(st.floats(width=32, allow_nan=False, allow_infinity=False))
            state.center_x = draw(COORDINATES)
            state.length = draw(st.floats(0, 50, width=32))
    ids = draw(st.lists(INT64, min_size=8, max_size=8, unique=True))
    for feature, feature_id in zip(message.map_features, ids, strict=True):
        feature.id = feature_id
        if feature.HasField("lane"):
            draw_relations(draw, feature.lane)
    for step in message.dynamic_map_states:
        for lane in draw(st.lists(INT64, max_size=2)):
            step.lane_states.add(lane=lane, state=draw(st.integers(0, 8)))
    return message


@given(message=scenarios())
def test_any_sound_record_is_read_as_protobuf_reads_it(message):
    found = decode_scene(message.SerializeToString())

    assert differences(found, expected_scene(message)) == []


def test_more_relations_than_any_map_holds_are_refused(monkeypatch):
    monkeypatch.setattr(wire, "MAX_FIELDS", 60)

    def change(message):
        for i in range(12):
            lane = message.map_features.add(id=1000 + i).lane
            lane.polyline.add(x=1000.0 + i)
            lane.entry_lanes.extend(range(5))

    with pytest.raises(RecordError, match="map has more than 60 relations"):
        scene_of(change)
