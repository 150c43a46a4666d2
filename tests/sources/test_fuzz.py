"""Whatever bytes come: a scene, or a named reason, and soon."""

import gzip
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.scene import Scene
from infgen.sources.tfrecord import BadRecord, RecordError, frame, iter_records
from infgen.sources.womd import decode_scene, iter_scenes
from tests.sources.records import SHARED, small_scenario
from tests.sources.test_wire import FIELDS, field_bytes

SOUND = small_scenario().SerializeToString()


def outcome(data: bytes) -> Scene | str:
    """Decode, letting through no other error than the one that names a reason."""
    try:
        scene = decode_scene(data)
    except RecordError as error:
        return str(error) or pytest.fail("no reason given")
    check_usable(scene)
    return scene


def check_usable(scene: Scene) -> None:
    """A scene that was let through is sound, whatever the bytes were."""
    tracks, road_map = scene.tracks, scene.road_map
    assert np.isfinite(tracks.xyz_m).all()
    assert np.isfinite(tracks.heading_rad).all()
    assert np.isfinite(road_map.xyz_m).all()
    assert np.isfinite(scene.signals.stop_xyz_m).all()
    assert len(set(tracks.id.tolist())) == tracks.num_agents
    assert tracks.valid[scene.ego, scene.now]
    assert road_map.point_offsets[-1] == len(road_map.xyz_m)
    assert (np.diff(road_map.point_offsets) >= 0).all()
    assert ((tracks.agent_type >= 0) & (tracks.agent_type <= 3)).all()


@given(at=st.integers(0, len(SOUND) - 1), bits=st.integers(1, 255))
def test_a_changed_byte_gives_a_scene_or_a_reason(at, bits):
    outcome(SOUND[:at] + bytes([SOUND[at] ^ bits]) + SOUND[at + 1 :])


@given(cut=st.integers(0, len(SOUND) - 1))
def test_a_cut_record_gives_a_reason_or_lacks_whole_fields(cut):
    outcome(SOUND[:cut])


@given(
    start=st.integers(0, len(SOUND)), size=st.integers(0, 200), junk=st.binary(max_size=200)
)
def test_replaced_bytes_give_a_scene_or_a_reason(start, size, junk):
    outcome(SOUND[:start] + junk + SOUND[start + size :])


@given(junk=st.binary(max_size=500))
def test_random_bytes_give_a_reason(junk):
    assert isinstance(outcome(junk), str)


@given(fields=st.lists(FIELDS, max_size=8))
def test_unknown_fields_around_a_sound_record_change_nothing(fields):
    more = b"".join(field_bytes(*field) for field in fields)

    assert isinstance(outcome(more + SOUND + more), Scene)


@given(
    number=st.sampled_from([1, 2, 4, 6, 7, 8, 10, 11]),
    wire_type=st.sampled_from([0, 2]),
    payload=st.binary(max_size=60),
)
def test_any_payload_in_a_known_field_gives_a_scene_or_a_reason(number, wire_type, payload):
    value = payload if wire_type == 2 else int.from_bytes(payload[:8], "little")
    outcome(SOUND + field_bytes(number, wire_type, value))


@given(data=st.data(), gzipped=st.booleans())
def test_damaged_files_name_every_record_that_is_lost(tmp_path_factory, data, gzipped):
    whole = b"".join(frame(small_scenario(name).SerializeToString()) for name in "abc")
    whole = gzip.compress(whole, 1) if gzipped else whole
    broken = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        broken[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    cut = data.draw(st.integers(0, len(whole)))
    path = tmp_path_factory.mktemp("files") / "training.tfrecord"
    path.write_bytes(broken[: cut or None])

    found = list(iter_scenes(path))

    kept = [scene.scenario_id for scene in found if isinstance(scene, Scene)]
    bad = [record for record in found if isinstance(record, BadRecord)]
    assert set(kept) <= {"a", "b", "c"}
    assert len(kept) == 3 or bad
    assert all(record.reason for record in bad)


@pytest.mark.parametrize("inner", [b"", b"\x58\x00", b"\x58\x01\x58\x00"])
def test_millions_of_tiny_messages_end_soon_and_are_refused(inner):
    states = field_bytes(3, 2, inner) * 300_000

    assert "states for 12 timestamps" in outcome(SOUND + field_bytes(2, 2, states))


def test_alternating_layouts_take_no_square_time():
    states = b"".join(field_bytes(3, 2, b"\x58\x00" * (i % 9)) for i in range(40_000))

    assert "states for 12 timestamps" in outcome(SOUND + field_bytes(2, 2, states))


def test_points_of_many_layouts_end_soon():
    rng = random.Random(0)
    fields = [b"\x09" + bytes(8), b"\x11" + bytes(8), b"\x19" + bytes(8), b"\x20\x01"]
    points = b"".join(
        field_bytes(2, 2, b"".join(rng.choices(fields, k=rng.randrange(8))))
        for _ in range(5_000)
    )
    feature = field_bytes(1, 0, 999) + field_bytes(5, 2, points)

    assert outcome(SOUND + field_bytes(8, 2, feature)) == "polyline 999 has zero length"


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared WOMD records")
def test_flips_in_a_real_record_give_a_scene_or_a_reason():
    record = next(iter(iter_records(min(SHARED.glob("truncated.*.gz")))))
    rng = random.Random(1)
    for _ in range(12):
        data = bytearray(record.data)
        for _ in range(rng.choice([1, 5, 50])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        outcome(bytes(data))
