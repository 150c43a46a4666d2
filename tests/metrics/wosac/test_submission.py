import gzip
import io
import struct
import tarfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.metrics.wosac.rollouts import Rollouts
from infgen.metrics.wosac.submission import Refused, read_submission
from tests.metrics.golden import GOLDEN, SETS, golden_rollouts, needs_goldens


def varint(value):
    found = b""
    while value > 0x7F:
        found += bytes([value & 0x7F | 0x80])
        value >>= 7
    return found + bytes([value])


def message(number, body):
    return varint(number << 3 | 2) + varint(len(body)) + body


def trajectory(object_id, steps=80, value=1.5, lengths=None):
    sizes = {2: steps, 3: steps, 4: steps, 5: steps, **(lengths or {})}
    body = b"".join(
        message(number, np.full(size, value + number, "<f4").tobytes())
        for number, size in sizes.items()
    )
    return message(1, body + varint(6 << 3) + varint(object_id))


def scenario(name="abc", rollouts=32, ids=(7, 3), **more):
    joint = b"".join(trajectory(object_id, **more) for object_id in ids)
    return message(1, name.encode()) + message(2, joint) * rollouts


def submission(*scenarios):
    return b"".join(message(1, one) for one in scenarios) + varint(2 << 3) + varint(1)


@pytest.fixture
def read(tmp_path):
    def from_bytes(data, **more):
        path = tmp_path / "submission.binproto"
        path.write_bytes(data)
        return list(read_submission(path, **more))

    return from_bytes


def tar(path, members, mode="w:gz"):
    with tarfile.open(path, mode) as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return path


def test_a_submission_is_read_scene_by_scene_with_objects_by_id(read):
    one, two = read(submission(scenario("abc"), scenario("def", ids=(1,))))

    assert isinstance(one, Rollouts)
    assert (one.scenario_id, two.scenario_id) == ("abc", "def")
    assert one.object_id.tolist() == [3, 7]
    assert one.x_m.shape == (32, 2, 80)
    assert (one.x_m[0, 0, 0], one.heading_rad[31, 1, 79]) == (3.5, 6.5)


def test_a_bare_scene_is_read_too(read):
    (one,) = read(scenario("abc"))

    assert one.scenario_id == "abc"


def test_members_of_an_archive_are_read_in_their_order(tmp_path):
    files = {
        "shard.binproto-00000-of-00002": submission(scenario("abc")),
        "shard.binproto-00001-of-00002": submission(scenario("def"), scenario("ghi")),
    }
    path = tar(tmp_path / "submission.tar.gz", files)

    assert [one.scenario_id for one in read_submission(path)] == ["abc", "def", "ghi"]


def test_a_member_with_a_path_out_of_the_archive_is_only_read(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    path = tar(inside / "s.tar.gz", {"../../evil": submission(scenario("abc"))})

    assert [one.scenario_id for one in read_submission(path)] == ["abc"]
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["inside", "s.tar.gz"]


def test_a_link_in_an_archive_is_refused_by_name(tmp_path):
    path = tmp_path / "s.tar"
    with tarfile.open(path, "w") as archive:
        link = tarfile.TarInfo("passwords")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)

    assert list(read_submission(path)) == [
        Refused("passwords", "not a plain file in the archive")
    ]


WRONG = {
    "31 rollouts": (scenario(rollouts=31), "has 31 rollouts; expected 32"),
    "no id": (message(2, trajectory(1)) * 32, "a scene without scenario_id"),
    "no objects": (scenario(ids=()), "a rollout without trajectories"),
    "axes of different length": (
        scenario(lengths={4: 79}),
        "object 7 has 79 values of center_z, object 7 has 80 of center_x",
    ),
    "other objects in one rollout": (
        scenario(rollouts=31) + message(2, trajectory(7) + trajectory(4)),
        "rollouts 0 and 31 are not of the same objects: 3, 4",
    ),
    "other steps in one rollout": (
        scenario(rollouts=31) + message(2, trajectory(7, 91) + trajectory(3, 91)),
        "rollout 31 has 2 trajectories of 91 steps, rollout 0 has 2 of 80",
    ),
    "half a float": (
        message(1, b"abc") + message(2, message(1, message(2, b"123"))) * 32,
        "packed field 2 is not a whole number of floats",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_scene_is_explained_in_one_line_and_the_next_is_read(read, name):
    wrong, reason = WRONG[name]

    refused, good = read(submission(wrong, scenario("def")))

    assert isinstance(refused, Refused)
    assert refused.reason == reason
    assert good.scenario_id == "def"


def test_any_number_of_rollouts_may_be_asked_for(read):
    (one,) = read(submission(scenario(rollouts=3)), num_rollouts=0)

    assert len(one.x_m) == 3


def test_a_file_that_is_no_submission_is_refused(read):
    for data in (b"", b"hello, this is not a message at all", gzip.compress(b"abc")):
        (refused,) = read(data)
        assert isinstance(refused, Refused)
        assert "\n" not in refused.reason


def test_a_file_cut_short_gives_what_is_whole_and_says_where_it_ends(read):
    data = submission(scenario("abc"), scenario("def"))

    whole, refused = read(data[: len(data) - 1000])

    assert whole.scenario_id == "abc"
    assert "ends within field 1" in refused.reason


def test_an_archive_cut_short_is_refused(tmp_path):
    whole = tar(tmp_path / "whole.tar.gz", {"a": submission(scenario("abc"))})
    cut = tmp_path / "cut.tar.gz"
    cut.write_bytes(whole.read_bytes()[:-200])

    found = list(read_submission(cut))
    assert isinstance(found[-1], Refused)


def test_a_length_beyond_reason_is_refused_before_it_is_read(read):
    (refused,) = read(varint(1 << 3 | 2) + varint(1 << 40))

    assert "holds" in refused.reason


def test_floats_that_are_not_packed_are_read(read):
    loose = b"".join(
        b"".join(varint(number << 3 | 5) + struct.pack("<f", 2.0) for _ in range(80))
        for number in (2, 3, 4, 5)
    )
    joint = message(1, loose + varint(6 << 3) + varint(9))
    (one,) = read(submission(message(1, b"abc") + message(2, joint) * 32))

    assert one.x_m.shape == (32, 1, 80)
    assert one.x_m.min() == one.z_m.max() == 2.0


@settings(max_examples=60)
@given(data=st.data())
def test_flipped_and_cut_bytes_never_crash_the_reader(tmp_path_factory, data):
    good = bytearray(submission(scenario(rollouts=2, steps=3), scenario("def", rollouts=2)))
    for _ in range(data.draw(st.integers(0, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("fuzz") / "s"
    path.write_bytes(good[: data.draw(st.integers(0, len(good)))])

    for found in read_submission(path, num_rollouts=0):
        assert isinstance(found, Rollouts | Refused)


@needs_goldens
def test_the_official_test_submission_is_read_to_the_last_bit():
    name = next(n for n in SETS if n.endswith("test_submission"))
    (one,) = read_submission(GOLDEN / name / "test_submission.binproto")
    official = golden_rollouts(name)

    assert one.scenario_id == official.scenario_id
    np.testing.assert_array_equal(one.object_id, official.object_id)
    for axis in ("x_m", "y_m", "z_m", "heading_rad"):
        np.testing.assert_array_equal(getattr(one, axis), getattr(official, axis))
