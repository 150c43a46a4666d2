"""File systems without locks or hard links, and runs on two machines."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.engine.manifest import verify
from tests.pipeline.conftest import TOYS

HERE = TOYS.parents[2]
OTHER = "node2"
ON_OTHER = """
import runpy, socket, sys
socket.sethostname(sys.argv.pop(1))
runpy.run_module("infgen", run_name="__main__")
"""
"""In a UTS namespace of its own a process has a host name of its own."""


@pytest.fixture
def on_other_machine(workshop):
    """``on_other_machine("run", ...)``: start a process under another host name."""
    started = []
    trial = subprocess.run(["unshare", "--uts", "true"], capture_output=True, check=False)
    if trial.returncode:
        pytest.skip("a host name of its own needs privileges: unshare --uts was refused")

    def start(*words):
        place = ("--root", str(workshop.root.path), "--file", str(workshop.file))
        records = ("--records", f"{workshop.texts}/*.txt")
        command = [sys.executable, "-c", ON_OTHER, OTHER, *words, *place, *records]
        paths = {"PYTHONPATH": os.pathsep.join([str(HERE), str(TOYS)])}
        process = subprocess.Popen(
            ["unshare", "--uts", *command],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            env={**os.environ, **paths}, start_new_session=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_for(condition):
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < 60
        time.sleep(0.02)


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_root_without_locks_is_refused_by_runs_and_can_be_looked_at(
    workshop, infgen, monkeypatch, number
):
    infgen("run")
    workshop.text("c.txt", "new")

    def refuse(handle, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    code, said = infgen("run")

    assert code == 1
    lock = workshop.root.lock("count")
    assert f"infgen: {lock} cannot be locked: {os.strerror(number)}; a root must" in said
    assert "mount this one with locks, or name another --root" in said
    assert infgen("status")[0] == 0


def test_no_run_makes_hard_links(workshop, infgen, monkeypatch, expected):
    def refuse(*paths, **options):
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)

    assert infgen("run")[0] == 0
    assert workshop.files() == expected


def test_a_run_on_another_machine_is_named_waited_for_and_outlived(
    workshop, infgen, on_other_machine, expected
):
    other = on_other_machine("run", "-s", "count.sleep_s=60")
    wait_for(workshop.root.attempt("count").is_file)

    code, said = infgen("run")
    os.killpg(other.pid, signal.SIGKILL)
    other.wait()
    again, _ = infgen("run", "--wait")

    assert code == 75
    assert f"by process {other.pid} on {OTHER} since" in said
    assert again == 0
    assert workshop.files() == expected


def test_runs_that_do_not_see_each_others_lock_undo_no_finished_work(
    workshop, infgen, on_other_machine, expected
):
    """As on disks whose locks hold for one machine only."""
    other = on_other_machine("run", "-s", "count.sleep_s=1")
    wait_for(lambda: list(workshop.root.units("count").glob("*.partial")))
    workshop.root.lock("count").unlink()

    here, _ = infgen("run", "-s", "count.sleep_s=1")
    _, said = other.communicate(timeout=60)
    again, _ = infgen("run", "-s", "count.sleep_s=1")

    assert here == 0
    assert other.returncode in (0, 1), said
    assert again == 0
    assert list(verify(workshop.root, full=True)) == []
    made = {name: data for name, data in workshop.files().items() if "manifest" not in name}
    assert sorted(made.values()) == sorted(
        data for name, data in expected.items() if "manifest" not in name
    )
