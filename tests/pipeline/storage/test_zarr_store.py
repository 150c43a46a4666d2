import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32, Int16

from infgen.scene import Scene
from pipeline.engine.atomic import StoreError
from pipeline.storage.group_file import open_group_file, write_group_file
from pipeline.storage.zarr_store import (
    open_group,
    read_group,
    read_records,
    write_group,
    write_records,
)

SCHEMA = "infgen.walks/1"


@dataclass(frozen=True, slots=True)
class Walk:
    name: str
    path_m: Float32[np.ndarray, "step 2"]
    mood: Int16[np.ndarray, " mood"]


def walks(count=5):
    rng = np.random.default_rng(0)
    return [
        Walk(f"walk {i}", rng.random((i, 2), np.float32), np.arange(3, dtype=np.int16))
        for i in range(count)
    ]


def assert_same(read, written):
    assert len(read) == len(written)
    for one, other in zip(read, written, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.path_m, other.path_m, strict=True)
        np.testing.assert_array_equal(one.mood, other.mood, strict=True)


@pytest.fixture
def group(tmp_path):
    path = tmp_path / "walks.zarr"
    write_records(path, walks(), Walk, SCHEMA, compress=False)
    return path


@pytest.mark.parametrize("compress", [False, True])
def test_records_come_back_from_disk(tmp_path, compress):
    write_records(tmp_path / "w.zarr", walks(), Walk, SCHEMA, compress=compress)

    assert_same(read_records(tmp_path / "w.zarr", Walk, SCHEMA, whole=True), walks())


def test_records_read_in_parts_are_the_same_and_not_to_be_written(group):
    opened = read_records(group, Walk, SCHEMA, whole=False)

    assert_same(opened, walks())
    with pytest.raises(ValueError, match="read-only"):
        opened[2].path_m[:] = 0


def test_of_columns_on_disk_only_what_is_asked_for_is_read(group):
    columns, _ = open_group(group)
    everything = columns["mood"][:]
    stored = group.read_bytes()
    place = stored.index(everything.tobytes())
    group.write_bytes(stored[: place + 12])

    np.testing.assert_array_equal(columns["mood"][2:6], [2, 0, 1, 2])
    assert len(columns["mood"]) == len(everything) == 15
    assert len(columns["mood"][6:3]) == 0
    with pytest.raises(StoreError, match=r"walks\.zarr is cut short"):
        columns["mood"][5:7]


def test_nothing_of_an_open_group_is_kept_open(group):
    before = os.listdir("/proc/self/fd")

    kept = [read_records(group, Walk, SCHEMA, whole=False) for _ in range(20)]
    records = [record for each in kept for record in each]

    assert len(records) == 100
    assert len(os.listdir("/proc/self/fd")) == len(before)
    assert str(group) not in Path("/proc/self/maps").read_text()


def test_a_group_that_is_gone_since_it_was_opened_is_an_error(group):
    opened = read_records(group, Walk, SCHEMA, whole=False)
    group.unlink()

    with pytest.raises(StoreError, match=r"walks\.zarr.*cannot be read"):
        opened[2]


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("whole", [True, False])
def test_no_records_at_all_come_back_too(tmp_path, compress, whole):
    if compress and not whole:
        pytest.skip("compressed groups are not read in parts")
    write_records(tmp_path / "w.zarr", [], Walk, SCHEMA, compress=compress)

    assert len(read_records(tmp_path / "w.zarr", Walk, SCHEMA, whole=whole)) == 0


def test_a_scene_comes_back_from_disk(tmp_path, crossing):
    scene = crossing()
    write_records(tmp_path / "s.zarr", [scene], Scene, "infgen.scenes/2", compress=True)

    (read,) = read_records(tmp_path / "s.zarr", Scene, "infgen.scenes/2", whole=True)

    np.testing.assert_array_equal(read.tracks.xyz_m, scene.tracks.xyz_m)
    np.testing.assert_array_equal(read.road_map.xyz_m, scene.road_map.xyz_m)
    assert read.scenario_id == scene.scenario_id


def test_equal_records_are_equal_bytes(tmp_path):
    for name in "ab":
        write_records(tmp_path / name, walks(), Walk, SCHEMA, compress=True)
    first, second = ((tmp_path / name).read_bytes() for name in "ab")

    assert first == second


def test_an_uncompressed_chunk_is_the_array_and_its_checksum(group):
    with zipfile.ZipFile(group) as archive:
        stored = archive.read("mood/c/0")

    assert stored[:-4] == np.tile(np.arange(3, dtype="<i2"), 5).tobytes()


def test_zeros_are_written_so_that_absence_is_never_zeros(tmp_path):
    write_group(tmp_path / "z.zarr", {"zero": np.zeros(9, np.int64)}, {}, compress=True)

    with zipfile.ZipFile(tmp_path / "z.zarr") as archive:
        assert "zero/c/0" in archive.namelist()


def test_another_schema_is_refused_by_name(group):
    with pytest.raises(
        StoreError, match=r"holds 'infgen.walks/1', expected 'infgen.runs/1'"
    ):
        read_records(group, Walk, "infgen.runs/1", whole=False)


def test_a_compressed_group_cannot_be_read_in_parts(tmp_path):
    write_records(tmp_path / "w.zarr", walks(), Walk, SCHEMA, compress=True)

    with pytest.raises(StoreError, match="compressed and cannot be read in parts"):
        open_group(tmp_path / "w.zarr")


def altered(group, key, change):
    """Write a group again, with other bytes for a key, or without it."""
    with zipfile.ZipFile(group) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    group.unlink()
    entries = {
        name: change(data) if name.startswith(key) else data
        for name, data in entries.items()
    }
    write_group_file(group, {k: data for k, data in entries.items() if data is not None})


def flipped(place):
    def flip(data):
        changed = bytearray(data)
        changed[place] ^= 1
        return bytes(changed)

    return flip


def flip_in_place(group, key):
    """Flip a bit of a chunk where it is, past the checksum of the archive."""
    with zipfile.ZipFile(group) as archive:
        data = archive.read(key)
    stored = group.read_bytes()
    group.write_bytes(stored.replace(data, flipped(3)(data)))


def gone(data):
    return None


def cut(data):
    return data[:-5]


CHUNK, ARRAY, GROUP = "path_m/c/0", "path_m/zarr.json", "zarr.json"
DAMAGES = {
    "a chunk is missing": lambda group: altered(group, CHUNK, gone),
    "a chunk is cut short": lambda group: altered(group, CHUNK, cut),
    "a chunk is emptied": lambda group: altered(group, CHUNK, lambda data: b""),
    "a bit of a value is flipped": lambda group: altered(group, CHUNK, flipped(3)),
    "a bit of a checksum is flipped": lambda group: altered(group, CHUNK, flipped(-1)),
    "a bit of the file is flipped": lambda group: flip_in_place(group, CHUNK),
    "an array is missing": lambda group: altered(group, "path_m", gone),
    "sizes are missing": lambda group: altered(group, "dim.step", gone),
    "an array's description is cut": lambda group: altered(group, ARRAY, cut),
    "the group's description is missing": lambda group: altered(group, GROUP, gone),
    "the group's description is cut": lambda group: altered(group, GROUP, cut),
    "the file is cut": lambda group: group.write_bytes(cut(group.read_bytes())),
    "the file is emptied": lambda group: group.write_bytes(b""),
    "the group is missing": lambda group: group.unlink(),
}
ONLY_SEEN_WHEN_READ = {
    "a bit of a value is flipped",
    "a bit of a checksum is flipped",
    "a bit of the file is flipped",
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("compress", [False, True])
def test_damage_is_an_error_when_read(tmp_path, damage, compress):
    group = tmp_path / "walks.zarr"
    write_records(group, walks(), Walk, SCHEMA, compress=compress)
    DAMAGES[damage](group)

    with pytest.raises(StoreError, match=r"walks\.zarr"):
        read_records(group, Walk, SCHEMA, whole=True)


@pytest.mark.parametrize("damage", sorted(DAMAGES.keys() - ONLY_SEEN_WHEN_READ))
def test_damage_of_form_is_an_error_when_mapped(group, damage):
    DAMAGES[damage](group)

    with pytest.raises(StoreError, match=r"walks\.zarr"):
        read_records(group, Walk, SCHEMA, whole=False)


def test_a_group_is_never_written_over(group):
    with pytest.raises(FileExistsError):
        write_records(group, walks(), Walk, SCHEMA, compress=False)


def test_read_group_gives_columns_and_attributes(group):
    columns, attributes = read_group(group)

    assert attributes == {"schema": SCHEMA, "count": 5}
    assert columns["dim.step"].tolist() == [0, 1, 2, 3, 4]


def as_folder(group):
    """Write the keys of a group as files of a folder, as was done before."""
    folder = group.with_name("folder.zarr")
    with zipfile.ZipFile(group) as archive:
        archive.extractall(folder)
    return folder


@pytest.mark.parametrize("whole", [True, False])
def test_a_folder_as_groups_were_before_is_read_alike(group, whole):
    assert_same(read_records(as_folder(group), Walk, SCHEMA, whole=whole), walks())


def test_zarr_reads_the_file_by_itself(group):
    import zarr  # noqa: PLC0415  # Only this test needs it.

    with zarr.storage.ZipStore(group, mode="r") as store:
        opened = zarr.open_group(store, mode="r")

        assert opened["mood"][:].tolist() == [0, 1, 2] * 5


def test_a_killed_write_leaves_no_group(tmp_path):
    class Killed(BaseException):
        pass

    class Entries(dict):
        def items(self):
            yield "zarr.json", b"{}"
            raise Killed

    with pytest.raises(Killed):
        write_group_file(tmp_path / "w.zarr", Entries())

    assert not (tmp_path / "w.zarr").exists()
    assert [path.suffix for path in tmp_path.iterdir()] == [".partial"]


def test_a_plain_column_that_is_read_whole_is_compared_with_its_checksum(tmp_path):
    path = tmp_path / "group.zarr"
    write_group(path, {"a": np.arange(5), "none": np.empty(0, np.int8)}, {}, compress=False)

    columns, _ = read_group(path)
    assert columns["a"].tolist() == [0, 1, 2, 3, 4]
    assert columns["none"].shape == (0,)
    columns["a"][0] = 7  # Arrays that torch may take over.

    data = bytearray(path.read_bytes())
    data[open_group_file(path)["a/c/0"].offset] ^= 1
    path.write_bytes(data)
    with pytest.raises(StoreError, match="a/c/0 is damaged: its checksum does not match"):
        read_group(path)
