"""Disks that are full, out of inodes, or read-only."""

import json
import re

import pytest

from pipeline.engine.atomic import DiskError, naming_refusals, publish
from pipeline.engine.events import Events
from pipeline.engine.layout import Root

FREE_BLOCKS = (0, 1, 2, 3, 5, 8, 13, 21, 34)
"""So many blocks of 4 KiB are free when a run starts; the toys need about 60."""
NEEDS = r"it needs more than [\d.e-]+ MiB \(written [\d.e-]+, free [\d.e-]+ of 1\)"


@pytest.mark.parametrize("free_blocks", FREE_BLOCKS)
def test_a_full_disk_stops_a_run_at_any_write_and_the_next_run_goes_on(
    workshop, small_disk, infgen, expected, free_blocks
):
    disk = small_disk(workshop.root.path, size="1m")
    disk.fill(free_blocks)

    code, said = infgen("run")

    left = list(disk.folder.rglob("*.partial"))
    disk.empty()
    again, _ = infgen("run")
    assert code == 1
    assert re.search(rf"{disk.folder}/\S+ cannot be written: No space left on device", said)
    assert re.search(NEEDS, said)
    assert "make room there and run again: what is finished is kept" in said
    assert left == []
    assert again == 0
    assert workshop.files() == expected


def test_a_disk_without_free_inodes_is_told_from_a_full_one(workshop, small_disk, infgen):
    small_disk(workshop.root.path, size="1m", nr_inodes="20")

    code, said = infgen("run")

    assert code == 1
    assert "No space left on device; all 20 files (inodes) that the disk can hold" in said


def emit_many(events):
    for number in range(100):
        events.emit("unit-done", unit=number, report="x" * 300)


def test_a_line_of_the_log_is_whole_or_absent(tmp_path, small_disk):
    disk = small_disk(tmp_path / "root", size="1m")
    disk.fill(3)
    events = Events(Root(disk.folder))

    with pytest.raises(DiskError, match=r"\.jsonl cannot be written: No space left"):
        emit_many(events)
    disk.empty()
    events.emit("run-stopped")

    lines = [json.loads(line) for line in events.log.read_text().splitlines()]
    assert [line.get("unit") for line in lines] == [*range(len(lines) - 1), None]


def test_errors_of_libraries_are_told_by_their_text(tmp_path):
    with (
        pytest.raises(
            DiskError, match=r"x cannot be written: Disk quota exceeded; .* 0 MiB"
        ),
        naming_refusals(tmp_path / "x"),
    ):
        raise RuntimeError("I/O error: Disk quota exceeded (os error 122)")


def publish_too_much(target):
    with publish(target) as partial:
        for number in range(6):
            (partial / f"{number}.bin").write_bytes(bytes(4096))
        (partial / "large.bin").write_bytes(bytes(1 << 20))


def test_what_was_written_of_a_folder_is_counted(tmp_path, small_disk):
    disk = small_disk(tmp_path / "disk", size="1m")
    disk.fill(10)

    with pytest.raises(DiskError, match=r"more than 0.0391 MiB \(written 0.0391, free 0 "):
        publish_too_much(disk.folder / "made")

    assert not (disk.folder / "made").exists()


def test_a_read_only_root_can_be_looked_at_and_is_named_by_a_run(
    workshop, read_only, infgen
):
    infgen("run")
    workshop.text("c.txt", "new")
    read_only(workshop.root.path)

    looks = [infgen(word)[0] for word in ("status", "plan")]
    code, said = infgen("run")

    assert looks == [0, 0]
    assert code == 1
    assert re.fullmatch(
        rf"infgen: {workshop.root.path}/\S+ cannot be written: Read-only file system; make "
        r"it writable, or name another --root\n",
        said,
    )
