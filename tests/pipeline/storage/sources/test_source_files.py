import gzip
import os
import struct

import fsspec
import google_crc32c
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from infgen.errors import ConfigError
from infgen.sources.tfrecord import BadRecord, iter_records
from infgen.sources.womd_write import encode_scenario
from pipeline.engine.events import Events
from pipeline.engine.garbage import remove_garbage
from pipeline.engine.layout import Root
from pipeline.engine.runner import RunOptions, run
from pipeline.engine.status import stage_statuses
from pipeline.settings.request import Request
from pipeline.settings.stages_file import DEFAULT_FILE
from pipeline.storage.sources.fingerprints import fingerprint
from pipeline.storage.sources.source_files import absolute, find_sources


def masked(data):
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def tfrecord(*records):
    lengths = [struct.pack("<Q", len(data)) for data in records]
    return b"".join(
        length + masked(length) + data + masked(data)
        for length, data in zip(lengths, records, strict=True)
    )


@pytest.fixture
def root(tmp_path):
    return Root(tmp_path / "root")


@pytest.fixture
def write(tmp_path):
    def build(name, data=b""):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path

    return build


def test_a_tfrecord_is_told_by_its_checksums_and_not_by_reading_it(write):
    path = write("a.tfrecord", tfrecord(b"one", b"two"))
    same = write("b.tfrecord", tfrecord(b"one", b"two"))

    assert fingerprint(path).startswith("tfrecord:")
    assert fingerprint(path) == fingerprint(same)
    assert fingerprint(path) != fingerprint(write("c", tfrecord(b"one", b"twp")))
    assert fingerprint(path) != fingerprint(write("d", tfrecord(b"two", b"one")))
    assert fingerprint(path) != fingerprint(write("e", tfrecord(b"one")))


@pytest.mark.parametrize("cut", [1, 4, 5, 12, 15])
def test_a_tfrecord_cut_short_is_told_by_all_its_bytes(write, cut):
    whole = tfrecord(b"one", b"two")

    assert fingerprint(write("a", whole[:-cut])).startswith("sha256:")


def test_a_damaged_length_is_told_by_all_bytes(write):
    data = bytearray(tfrecord(b"one", b"two"))
    data[0] ^= 1

    assert fingerprint(write("a", bytes(data))).startswith("sha256:")


@given(
    length=st.integers(0, 2**64 - 1),
    held=st.binary(max_size=40),
    before=st.lists(st.binary(max_size=8), max_size=2),
)
@example(length=2**63 - 8, held=b"", before=[])
@example(length=2**63 - 1, held=b"12345678", before=[b"one"])
@example(length=2**64 - 1, held=b"", before=[])
@example(length=3, held=b"one" + masked(b"one"), before=[b"two"])
def test_a_length_that_its_file_does_not_hold_is_told_by_all_bytes(
    tmp_path_factory, length, held, before
):
    """Whatever a sound header says, the file is told and read, and nothing is raised."""
    header = struct.pack("<Q", length)
    path = tmp_path_factory.mktemp("crafted") / "a"
    path.write_bytes(tfrecord(*before) + header + masked(header) + held)

    whole = len(held) == length + 4

    assert fingerprint(path).startswith("tfrecord:" if whole else "sha256:")
    records = list(iter_records(path))
    assert [record.number for record in records[: len(before)]] == list(range(len(before)))
    assert whole or isinstance(records[-1], BadRecord)


def test_other_files_are_told_by_all_their_bytes(write):
    packed = write("a.gz", gzip.compress(tfrecord(b"one")))

    assert fingerprint(packed).startswith("sha256:")
    assert fingerprint(write("zeros", bytes(1 << 20))).startswith("sha256:")


def test_paths_folders_and_patterns_name_files_once_and_in_order(write, root, tmp_path):
    one, two = write("d/b.tfrecord-1", tfrecord(b"1")), write("d/a.tfrecord-2", b"2")
    write("d/manifest.json")

    found = find_sources([str(tmp_path / "d"), str(tmp_path / "*/*.tfrecord-1")], root)

    assert [source.name for source in found] == ["a.tfrecord-2", "b.tfrecord-1"]
    assert [source.url for source in found] == [str(two), str(one)]


def test_a_file_with_pattern_letters_in_its_name_is_found(write, root):
    path = write("odd[1].tfrecord", b"1")

    assert [source.url for source in find_sources([str(path)], root)] == [str(path)]


def test_identities_are_remembered_until_a_file_changes(write, root, monkeypatch):
    path = write("a.tfrecord", tfrecord(b"one"))
    (before,) = find_sources([str(path)], root)
    monkeypatch.setattr(
        "pipeline.storage.sources.fingerprints.fingerprint", lambda path: "read again"
    )

    (known,) = find_sources([str(path)], root)
    os.utime(path, ns=(1, 1))
    (touched,) = find_sources([str(path)], root)

    assert known == before
    assert touched.fingerprint == "read again"


def test_a_damaged_memory_costs_only_time(write, root):
    path = write("a.tfrecord", tfrecord(b"one"))
    before = find_sources([str(path)], root)
    root.fingerprints.write_text("{")

    assert find_sources([str(path)], root) == before


@pytest.fixture
def ingest(root):
    """``ingest(files)`` makes the stage of some files and gives what became of it."""

    def make(*files):
        request = Request(root, DEFAULT_FILE, None, tuple(map(str, files)), ())
        plan = request.plan(("ingest",), {})
        (stage_status,) = stage_statuses(plan, request.made())
        request.remember(plan)
        (result,) = run(plan, RunOptions(), Events(root, ()))
        return stage_status, result

    return make


@pytest.fixture
def records(scenes):
    return [encode_scenario(scene) for scene in scenes]


@pytest.fixture
def damaged(write, records):
    """A file whose second record is damaged, as a bad download leaves it."""
    data = bytearray(tfrecord(*records))
    data[len(tfrecord(records[0])) + 12 + len(records[1]) // 2] ^= 1
    return write("bad.tfrecord", bytes(data))


def download(path, *records):
    """Put another file in its place."""
    fresh = path.with_name("fresh")
    fresh.write_bytes(tfrecord(*records))
    fresh.replace(path)


def test_a_damaged_file_is_read_again_when_it_was_mended(write, ingest, damaged, records):
    good = write("good.tfrecord", tfrecord(records[0]))
    _, before = ingest(damaged, good)
    assert (before.report["quarantined"], before.made) == (1, 2)
    assert ingest(damaged, good)[0].state == "cached"

    download(damaged, *records)

    stage_status, repaired = ingest(damaged, good)
    assert (stage_status.state, stage_status.why) == (
        "stale",
        "1 changed file bad.tfrecord; 1 of 2 units made",
    )
    assert (repaired.state, repaired.made, repaired.report["quarantined"]) == ("made", 1, 0)
    assert ingest(damaged, good)[0].state == "cached"


@pytest.mark.parametrize("lost", ["memory", "damaged scenes", None])
def test_a_mended_file_stays_told_by_all_its_bytes(ingest, damaged, records, root, lost):
    ingest(damaged)
    download(damaged, *records)
    _, repaired = ingest(damaged)

    os.utime(damaged, ns=(1, 1))
    if lost == "memory":
        root.fingerprints.unlink()
    elif lost:
        assert len(remove_garbage(root)) == 2  # The stage and its unit.

    stage_status, again = ingest(damaged)
    assert (stage_status.state, again.key) == ("cached", repaired.key)


def test_a_file_cut_short_is_told_as_any_other_once_it_is_whole(write, records, root):
    path = write("a.tfrecord", tfrecord(*records)[:-1])
    (short,) = find_sources([str(path)], root)

    download(path, *records)

    (whole,) = find_sources([str(path)], root)
    assert short.fingerprint.startswith("sha256:")
    assert whole.fingerprint == fingerprint(path)


def test_a_file_that_is_still_as_damaged_is_not_read_again(ingest, damaged):
    _, before = ingest(damaged)
    copy = damaged.with_name("copy")
    copy.write_bytes(damaged.read_bytes())
    copy.replace(damaged)

    stage_status, after = ingest(damaged)
    assert (stage_status.state, after.key) == ("cached", before.key)


def test_sound_records_that_are_no_use_give_no_reason_to_read_a_file_again(
    write, ingest, records
):
    path = write("odd.tfrecord", tfrecord(b"no scene", *records, records[0]))
    _, before = ingest(path)
    assert before.report["quarantined"] == 2

    os.utime(path, ns=(1, 1))

    stage_status, after = ingest(path)
    assert (stage_status.state, after.key) == ("cached", before.key)


def test_nothing_found_is_an_error_that_names_the_pattern(root, tmp_path):
    with pytest.raises(ConfigError, match=r"no records match .*/none\*"):
        find_sources([str(tmp_path / "none*")], root)
    with pytest.raises(ConfigError, match="no records are named"):
        find_sources([], root)


def test_two_files_of_one_name_are_both_named(write, root, tmp_path):
    write("x/a.tfrecord"), write("y/a.tfrecord")

    with pytest.raises(ConfigError, match=r"x/a\.tfrecord and .*/y/a\.tfrecord"):
        find_sources([str(tmp_path / "*" / "a.tfrecord")], root)


def test_remote_files_are_found_by_url_and_told_without_their_names(root):
    system = fsspec.filesystem("memory")
    for name, data in (("one", b"1"), ("two", b"2")):
        system.pipe_file(f"/records/{name}.tfrecord", data)

    found = find_sources(["memory://records/*.tfrecord"], root)
    (single,) = find_sources(["memory://records/one.tfrecord"], root)

    assert [source.name for source in found] == ["one.tfrecord", "two.tfrecord"]
    assert found[0] == single
    assert found[0].fingerprint != found[1].fingerprint
    with pytest.raises(ConfigError, match="no records match memory://"):
        find_sources(["memory://records/three.tfrecord"], root)


def test_a_store_that_knows_checksums_is_believed(monkeypatch, root):
    system = fsspec.filesystem("memory")
    system.pipe_file("/told/a.tfrecord", b"1")
    about = {"name": "/told/a.tfrecord", "type": "file", "size": 1, "ETag": "abc"}
    monkeypatch.setattr(type(system), "info", lambda self, path, **more: dict(about))

    (first,) = find_sources(["memory://told/a.tfrecord"], root)
    about["LastModified"] = "later"
    (moved,) = find_sources(["memory://told/a.tfrecord"], root)
    about["ETag"] = "abd"
    (changed,) = find_sources(["memory://told/a.tfrecord"], root)

    assert first == moved != changed


def test_local_words_are_made_absolute_and_others_left(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    assert absolute("a/*.tfrecord") == str(tmp_path / "a/*.tfrecord")
    assert absolute("file:///a/b") == "/a/b"
    assert absolute("gs://a/b") == "gs://a/b"
    assert absolute("builtin") == "builtin"
