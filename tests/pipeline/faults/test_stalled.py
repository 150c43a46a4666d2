"""Records on a network mount that is slow, that gives up, or that never answers."""

import os
import signal
import threading
import time

import fsspec
import pytest
from fsspec.implementations.local import LocalFileSystem

from cli import main
from infgen.sources.womd_write import encode_scenario
from pipeline.engine.layout import Root
from tests.sources.records import write_tfrecord

ANSWER_S = 0.002


class SlowFile:
    """A file whose every read takes its time, or goes wrong."""

    def __init__(self, file, on_read):
        self._file, self._on_read = file, on_read

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()

    def read(self, size):
        self._on_read()
        return self._file.read(size)


class SlowMount(LocalFileSystem):
    """Local files as ``slow://`` URLs."""

    protocol = "slow"
    on_read = staticmethod(lambda: time.sleep(ANSWER_S))

    def _open(self, path, mode="rb", **more):
        return SlowFile(super()._open(path, mode, **more), type(self).on_read)


@pytest.fixture
def mount(monkeypatch):
    """``mount(on_read)``: the slow file system, which does that on every read."""
    fsspec.register_implementation("slow", SlowMount, clobber=True)

    def set_on_read(on_read):
        monkeypatch.setattr(SlowMount, "on_read", staticmethod(on_read))

    return set_on_read


@pytest.fixture
def path(tmp_path, scenes):
    records = [encode_scenario(scene) for scene in scenes]
    return write_tfrecord(tmp_path / "training.tfrecord-0", records)


def ingest(url, root):
    with pytest.raises(SystemExit) as left:
        main(["ingest", str(url), "--root", str(root.path)])
    return left.value.code or 0


def scenes_of(root):
    files = root.units("ingest").glob("*/*")
    return {file.name: file.read_bytes() for file in files if file.suffix == ".zarr"}


def test_a_slow_mount_gives_the_same_scenes(tmp_path, path, mount):
    near, far = Root(tmp_path / "near"), Root(tmp_path / "far")

    assert ingest(path, near) == ingest(f"slow://{path}", far) == 0
    assert scenes_of(near) == scenes_of(far) != {}


def test_a_mount_that_gives_up_fails_its_file_and_the_next_run_goes_on(
    tmp_path, path, mount, capsys
):
    root = Root(tmp_path / "root")

    def give_up():
        raise TimeoutError("the mount does not answer")

    mount(give_up)
    code = ingest(f"slow://{path}", root)
    said = capsys.readouterr().err
    mount(lambda: None)
    again = ingest(f"slow://{path}", root)

    assert code == 1
    assert f"unit {path.name} failed: TimeoutError: the mount does not answer" in said
    assert again == 0
    assert scenes_of(root)


def test_a_run_that_waits_for_a_mount_ends_with_a_signal_and_leaves_nothing(
    tmp_path, path, mount
):
    root, stalled = Root(tmp_path / "root"), threading.Event()

    def stall():
        stalled.set()
        for _ in range(6000):
            time.sleep(0.01)

    def stop_once_stalled():
        stalled.wait(60)
        os.kill(os.getpid(), signal.SIGTERM)

    mount(stall)
    stopper = threading.Thread(target=stop_once_stalled)
    stopper.start()
    code = ingest(f"slow://{path}", root)
    stopper.join()

    assert code == 128 + signal.SIGTERM
    assert not list(root.store.rglob("*.partial"))
    assert not list(root.made())
