import os
import subprocess
import sys
import threading

import pytest

from pipeline.engine.locks import LockedError, holder, is_locked, locked

HOLDER = """
import sys, time
from pathlib import Path
from pipeline.engine.locks import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def lock(tmp_path):
    return tmp_path / "stage" / "lock"


@pytest.fixture
def other(lock):
    """Another process that holds the lock."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, lock], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_lock_is_held_for_the_length_of_the_block(lock):
    assert not is_locked(lock)
    with locked(lock):
        assert is_locked(lock)
    assert not is_locked(lock)


def test_a_second_run_is_told_who_holds_it_and_since_when(lock, other):
    with pytest.raises(LockedError) as refused, locked(lock):
        pass

    assert f"process {other.pid} on {os.uname().nodename} since 20" in str(refused.value)
    assert "--wait" in str(refused.value)
    assert holder(lock)["pid"] == other.pid


def test_a_lock_dies_with_its_process(lock, other):
    other.kill()
    other.wait()

    with locked(lock):
        assert holder(lock)["pid"] == os.getpid()


def test_waiting_ends_when_the_other_ends(lock, other):
    threading.Timer(0.3, other.kill).start()

    with locked(lock, wait=True):
        assert other.wait() == -9


def test_looking_does_not_get_in_the_way(lock):
    with locked(lock):
        pass
    stop = threading.Event()

    def look():
        while not stop.is_set():
            is_locked(lock)

    looker = threading.Thread(target=look)
    looker.start()
    for _ in range(50):
        with locked(lock):
            pass
    stop.set()
    looker.join()


def test_a_holder_that_wrote_nothing_is_still_a_holder(lock):
    with locked(lock):
        lock.write_text("{")
        assert holder(lock) == {}
        with pytest.raises(LockedError, match="another process"), locked(lock):
            pass
