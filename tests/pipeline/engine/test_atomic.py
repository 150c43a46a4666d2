import json
import os
import subprocess
import sys
import time

import pytest

from pipeline.engine.atomic import (
    MANIFEST,
    StoreError,
    publish,
    remove_folder,
    write_file,
    write_json,
)


def test_a_folder_appears_only_when_all_is_written(tmp_path):
    target = tmp_path / "target"

    with publish(target) as partial:
        (partial / "deep").mkdir()
        (partial / "deep" / "file").write_text("text")
        assert not target.exists()

    assert (target / "deep" / "file").read_text() == "text"
    assert os.listdir(tmp_path) == ["target"]


def write_half(target, *, resume):
    with publish(target, resume=resume) as partial:
        (partial / "file").write_text("half")
        raise RuntimeError


def test_nothing_is_left_when_the_writer_fails(tmp_path):
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "target", resume=False)

    assert os.listdir(tmp_path) == []


def test_a_resuming_writer_finds_what_it_left(tmp_path):
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "t", resume=True)

    with publish(tmp_path / "t", resume=True) as partial:
        assert (partial / "file").read_text() == "half"


def test_a_resuming_writer_does_not_publish_half_written_files(tmp_path):
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "t", resume=True)
    (tmp_path / "t.partial" / "deep").mkdir()
    (tmp_path / "t.partial" / "about.json.0a1b2c3d.partial").write_text("{")
    (tmp_path / "t.partial" / "deep" / "rows.parquet.partial").write_text("PAR")

    with publish(tmp_path / "t", resume=True):
        pass

    assert sorted(p.name for p in (tmp_path / "t").rglob("*")) == ["deep", "file"]


def write_sealed(partial, text):
    (partial / "file").write_text(text)
    (partial / MANIFEST).write_text("{}")


def test_of_two_writers_the_first_to_finish_wins(tmp_path):
    with publish(tmp_path / "t") as late:
        write_sealed(late, "late")
        with publish(tmp_path / "t") as early:
            write_sealed(early, "early")

    assert (tmp_path / "t" / "file").read_text() == "early"
    assert os.listdir(tmp_path) == ["t"]


def test_what_was_half_removed_gives_way_to_what_is_whole(tmp_path):
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "left").write_text("left")

    with publish(tmp_path / "t") as partial:
        write_sealed(partial, "new")

    assert sorted(os.listdir(tmp_path / "t")) == ["file", MANIFEST]
    assert os.listdir(tmp_path) == ["t"]


def test_a_folder_of_somebody_else_is_not_replaced_in_silence(tmp_path):
    def write():
        with publish(tmp_path / "t", resume=True) as partial:
            (partial / "file").write_text("ours")
            (tmp_path / "t").mkdir()
            (tmp_path / "t" / "theirs").write_text("theirs")

    with pytest.raises(StoreError, match=r"t is in the way; move it elsewhere"):
        write()

    assert os.listdir(tmp_path / "t") == ["theirs"]


def test_who_lost_its_folder_does_not_publish_what_it_writes_after_that(tmp_path):
    def write():
        with publish(tmp_path / "t") as partial:
            (partial / "first").write_text("first")
            remove_folder(partial)
            partial.mkdir(parents=True)  # As zarr does for the file that it writes.
            write_sealed(partial, "last")

    with pytest.raises(StoreError, match="removed by another run while it was written"):
        write()

    assert os.listdir(tmp_path) == []


WRITER = """
import sys
from pathlib import Path
from pipeline.engine.atomic import publish
while True:
    for number in range(1000):
        with publish(Path(sys.argv[1]) / str(number)) as partial:
            for name in "abc":
                (partial / name).write_text("whole")
            print(number, flush=True)
"""


def test_a_killed_writer_leaves_whole_folders_or_partial_ones(tmp_path):
    for pause_s in (0.0, 0.003, 0.011, 0.02):
        folder = tmp_path / str(pause_s)
        folder.mkdir()
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, folder], stdout=subprocess.PIPE
        )
        process.stdout.readline()
        time.sleep(pause_s)
        process.kill()
        process.communicate()
        for path in folder.iterdir():
            whole = sorted(p.name for p in path.iterdir()) == ["a", "b", "c"]
            assert path.name.endswith(".partial") or whole


def test_a_file_is_replaced_in_one_step(tmp_path):
    path = tmp_path / "file"
    write_file(path, b"one")
    write_file(path, b"two")

    assert path.read_bytes() == b"two"
    assert os.listdir(tmp_path) == ["file"]


def test_equal_values_are_equal_json(tmp_path):
    write_json(tmp_path / "a", {"x": 1, "y": [1.5, None]})
    write_json(tmp_path / "b", {"y": [1.5, None], "x": 1})

    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert json.loads((tmp_path / "a").read_text()) == {"x": 1, "y": [1.5, None]}


def test_all_is_on_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done = []
    fsync, rename = os.fsync, os.rename

    def note_sync(handle):
        done.append(os.path.basename(os.readlink(f"/proc/self/fd/{handle}")))
        fsync(handle)

    def note_rename(old, new):
        done.append(f"-> {os.path.basename(new)}")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "rename", note_rename)
    with publish(tmp_path / "target") as partial:
        (partial / "file").write_text("text")

    assert done == ["file", partial.name, "-> target", tmp_path.name]
