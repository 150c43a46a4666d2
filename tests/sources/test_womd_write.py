import dataclasses
import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.scene import RoadMap, Signals, Tracks
from infgen.sources.tfrecord import iter_records
from infgen.sources.towns import builtin_records
from infgen.sources.wire_write import varint
from infgen.sources.womd import decode_scene, iter_scenes
from infgen.sources.womd_write import encode_scenario, write_tfrecord
from tests.sources.oracle import expected_scene
from tests.sources.records import NOW, SHARED, changed, small_scenario
from tests.sources.scenario_proto import Scenario


def assert_same(one, other, atol=0.0):
    """Compare records field by field, nested ones too."""
    for field in dataclasses.fields(one):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(mine):
            assert_same(mine, theirs, atol)
        elif isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype, field.name
            assert mine.shape == theirs.shape, field.name
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=atol, err_msg=field.name)
        else:
            assert mine == theirs, field.name


@pytest.fixture(scope="module")
def small():
    return expected_scene(small_scenario())


@pytest.fixture(scope="module")
def town():
    return next(iter_scenes(builtin_records()[-1]))


def test_protobuf_reads_back_the_scene_that_was_written(small):
    assert_same(expected_scene(Scenario.FromString(encode_scenario(small))), small)


def test_our_own_reader_reads_back_the_scene_that_was_written(small):
    assert_same(decode_scene(encode_scenario(small)), small)


def test_a_town_survives_the_way_to_a_record_and_back(town):
    data = encode_scenario(town)

    assert_same(decode_scene(data), town)
    assert_same(expected_scene(Scenario.FromString(data)), town)


def test_positions_are_written_in_the_world_frame(small):
    message = Scenario.FromString(encode_scenario(small))

    state = message.tracks[0].states[NOW]
    assert (state.center_x, state.center_y, state.center_z) == (1000.5, -2000.25, 30.125)
    assert message.map_features[0].lane.polyline[0].x == 1000.0


def test_official_bytes_are_reproduced_where_every_field_is_set():
    # protobuf writes in ascending order of fields too.
    def complete(message):
        for track in message.tracks:
            for state in track.states:
                if state.valid:
                    state.center_x = round(state.center_x * 16) / 16
                else:
                    state.Clear()
                    state.valid = False
        for feature in message.map_features:
            _round_points(feature)
        message.map_features[0].lane.right_boundaries[0].boundary_type = 0

    data = changed(complete)

    assert encode_scenario(decode_scene(data)) == data


def _round_points(feature):
    """Leave to points what a float32 near the origin can hold."""
    for _, part in feature.ListFields()[1:]:
        for name in ("polyline", "polygon"):
            for point in getattr(part, name, []):
                point.y = round(point.y * 16) / 16


def test_an_unseen_state_with_values_keeps_them(small):
    xyz_m = small.tracks.xyz_m.copy()
    xyz_m[1, 0] = (5.0, 6.0, 7.0)
    scene = dataclasses.replace(
        small, tracks=dataclasses.replace(small.tracks, xyz_m=xyz_m)
    )

    message = Scenario.FromString(encode_scenario(scene))

    state = message.tracks[1].states[0]
    assert not state.valid
    # The origin is the whole metres nearest to the ego: (1000, -2000, 30).
    assert (state.center_x, state.center_y, state.center_z) == (1005.0, -1994.0, 37.0)


def test_an_unseen_state_without_values_is_only_a_flag(small):
    state = Scenario.FromString(encode_scenario(small)).tracks[1].states[0]

    assert [field.name for field, _ in state.ListFields()] == ["valid"]


def test_negative_ids_are_written_as_protobuf_writes_them(small):
    ids = np.array([-1, 9], np.int32)
    tracks = dataclasses.replace(small.tracks, id=ids)

    message = Scenario.FromString(
        encode_scenario(dataclasses.replace(small, tracks=tracks))
    )

    assert [track.id for track in message.tracks] == [-1, 9]


def test_steps_without_a_signal_are_written_too(small):
    signals = small.signals
    kept = signals.step == 3
    few = Signals(
        signals.step[kept],
        signals.lane_id[kept],
        signals.state[kept],
        signals.stop_xyz_m[kept],
    )

    message = Scenario.FromString(encode_scenario(dataclasses.replace(small, signals=few)))

    counts = [len(state.lane_states) for state in message.dynamic_map_states]
    assert counts == [0, 0, 0, 1, *[0] * 8]


def test_a_scene_without_a_map_or_roles_is_written(small):
    empty = {
        field.name: getattr(small.road_map, field.name)[:0]
        for field in dataclasses.fields(RoadMap)
    }
    road_map = RoadMap(**{**empty, "point_offsets": np.zeros(1, np.int64)})
    none = np.zeros(0, np.int32)
    scene = dataclasses.replace(
        small,
        road_map=road_map,
        predict_row=none,
        predict_difficulty=none.astype(np.int8),
        interest_id=none,
    )

    assert_same(decode_scene(encode_scenario(scene)), scene)


@given(st.integers(0, 2**63 - 1))
def test_varints_hold_seven_bits_a_byte_lowest_first(value):
    written = varint(value)

    assert sum((byte & 0x7F) << 7 * at for at, byte in enumerate(written)) == value
    assert [byte >> 7 for byte in written] == [1] * (len(written) - 1) + [0]


@pytest.mark.parametrize("name", ["a.tfrecord-00000-of-00001", "a.tfrecord.gz"])
def test_records_come_back_from_a_file_plain_or_gzipped(tmp_path, name):
    write_tfrecord(tmp_path / name, [b"one", b"", b"three"])

    assert [record.data for record in iter_records(tmp_path / name)] == [
        b"one",
        b"",
        b"three",
    ]


def test_a_file_does_not_depend_on_its_name_or_when_it_was_written(tmp_path):
    write_tfrecord(tmp_path / "a.gz", [b"one"])
    write_tfrecord(tmp_path / "b.gz", [b"one"])

    assert (tmp_path / "a.gz").read_bytes() == (tmp_path / "b.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.gz").read_bytes())[12:15] == b"one"


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared driving logs")
@pytest.mark.parametrize("split", ["validation", "training", "long_20s", "truncated"])
def test_real_logs_survive_being_written_and_read_again(split):
    path = sorted(SHARED.glob(f"{split}.tfrecord*"))[0]
    for record, _ in zip(iter_records(path), range(1), strict=False):
        scene = decode_scene(record.data)

        again = decode_scene(encode_scenario(scene))

        # A float32 next to the origin is finer than a double far from it can hold.
        assert_same(again, scene, atol=2e-12)


def test_tracks_of_every_kind_keep_it(small):
    kinds = np.array([3, 2], np.int8)
    tracks: Tracks = dataclasses.replace(small.tracks, agent_type=kinds)

    message = Scenario.FromString(
        encode_scenario(dataclasses.replace(small, tracks=tracks))
    )

    assert [track.object_type for track in message.tracks] == [4, 3]
