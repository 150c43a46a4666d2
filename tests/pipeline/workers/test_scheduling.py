"""Handing out units, with a pool of threads instead of machines."""

import functools
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

import pytest

from pipeline.engine.stage import Unit
from pipeline.engine.units import Outcome, Task, WorkersLostError
from pipeline.workers import scheduling
from pipeline.workers.scheduling import (
    DeviceFailed,
    PoolExecutor,
    TaskEnded,
    TaskFailure,
    TaskProgress,
    TimeLimitExceeded,
    WorkerLost,
    WorkerMemoryFull,
)


class KilledError(Exception):
    pass


@dataclass
class Threads:
    """A pool of threads. ``jobs`` say what a unit does besides being done."""

    size: int = 2
    jobs: dict = field(default_factory=dict)
    lost: bool = False
    inbox: SimpleQueue = field(default_factory=SimpleQueue)
    at_once: int = 0
    most: int = 0
    begun: list = field(default_factory=list)

    def __post_init__(self):
        self._pool = ThreadPoolExecutor(max(1, self.size))
        self._futures = {}
        self._lock = threading.Lock()

    def begin(self, name, task):
        with self._lock:
            self.at_once += 1
            self.most = max(self.most, self.at_once)
        self.begun.append(name)
        future = self._pool.submit(self._do, name, task)
        self._futures[name] = future
        future.add_done_callback(lambda _: self.inbox.put(TaskEnded(name)))

    def _do(self, name, task):
        self.jobs.get(task.unit.name, lambda name: None)(name)
        return Outcome(task.unit.name, {}, 0.0)

    def take(self, name):
        with self._lock:
            self.at_once -= 1
        error = self._futures.pop(name).exception()
        if isinstance(error, WorkersLostError):
            raise error
        if error is not None:
            return TaskFailure(error, "", isinstance(error, KilledError))
        return Outcome(name, {}, 0.0)

    def threads(self):
        if self.lost:
            raise WorkersLostError("lost")
        return self.size


def tasks(count):
    return [
        Task("", Unit(f"u{at}", {}, {}), Path(f"k{at}"), None, {"stage": "play"})
        for at in range(count)
    ]


def run(pool, count, may_start=lambda: True, told=None, heard=None):
    def progress(done, total, note=""):
        (heard if heard is not None else []).append((done, total, note))

    def tell(event, **figures):
        (told if told is not None else []).append((event, figures))

    return list(PoolExecutor(pool).run(tasks(count), may_start, progress, tell))


def test_never_more_than_two_tasks_a_thread_are_handed_out():
    pool = Threads(size=3)

    outcomes = run(pool, 5500)  # All of validation, eight scenes a unit.

    assert len(outcomes) == 5500
    assert 3 <= pool.most <= 6


def test_tasks_are_begun_in_order():
    pool = Threads(size=1)

    run(pool, 5)

    assert pool.begun == [f"play-k{at}" for at in range(5)]


def test_none_is_begun_once_it_is_not_to_go_on():
    pool, asked = Threads(size=1), []

    def may_start():
        asked.append(None)
        return len(asked) <= 3

    assert len(run(pool, 100, may_start)) == len(pool.begun) <= 3


def die(names, name):
    if name in names:
        raise KilledError(name)


def test_who_was_beside_a_killer_is_done_in_the_end_alone():
    # Unit 1 kills its worker each time; unit 2 is on the same worker the first time.
    jobs = {
        "u1": functools.partial(die, {"play-k1", "play-k1-alone"}),
        "u2": functools.partial(die, {"play-k2"}),
    }
    pool = Threads(size=2, jobs=jobs)

    outcomes = {outcome.name: outcome for outcome in run(pool, 6)}

    assert outcomes["u1"].error == "KilledError: play-k1-alone"
    assert "play-k2-alone" in outcomes, "it is done"
    assert len(outcomes) == 6
    assert pool.begun[-2:] == ["play-k1-alone", "play-k2-alone"]


def test_other_errors_are_not_tried_again():
    def fail(name):
        raise ValueError("bad")

    pool = Threads(jobs={"u0": fail})

    assert [each.error for each in run(pool, 2)].count("ValueError: bad") == 1
    assert pool.begun == ["play-k0", "play-k1"]


def test_a_crew_that_is_lost_ends_the_run_at_once():
    def lose(name):
        raise WorkersLostError("gone")

    with pytest.raises(WorkersLostError, match="gone"):
        run(Threads(jobs={"u1": lose}), 10)


def test_a_crew_that_does_not_answer_ends_the_run(monkeypatch):
    monkeypatch.setattr(scheduling, "COUNT_WORKERS_EVERY_S", 0.05)
    pool = Threads()

    def hang(name):
        pool.lost = True
        time.sleep(0.5)

    pool.jobs["u0"] = hang
    with pytest.raises(WorkersLostError, match="lost"):
        run(pool, 3)


def test_without_workers_a_run_waits_for_some_time(monkeypatch):
    monkeypatch.setattr(scheduling, "COUNT_WORKERS_EVERY_S", 0.02)
    monkeypatch.setattr(scheduling, "NO_WORKER_TIMEOUT_S", 0.2)
    told, pool = [], Threads(size=0, jobs={"u0": lambda name: time.sleep(1)})

    with pytest.raises(WorkersLostError, match=r"no worker for 0.00333333 minutes"):
        run(pool, 1, told=told)

    assert [event for event, _ in told] == ["workers-missing"]


def test_a_cluster_that_grows_is_given_more(monkeypatch):
    monkeypatch.setattr(scheduling, "COUNT_WORKERS_EVERY_S", 0.02)
    pool = Threads(size=1)
    pool._pool = ThreadPoolExecutor(8)

    def grow(name):
        pool.size = 4
        time.sleep(0.1)

    pool.jobs = {f"u{at}": grow for at in range(20)}
    run(pool, 20)

    assert 2 < pool.most <= 8


def test_what_happens_to_workers_is_told():
    told, pool = [], Threads(size=1)

    def fall(name):
        pool.inbox.put(WorkerMemoryFull("tcp://w", 3 << 30))
        pool.inbox.put(WorkerLost("tcp://w", (name, "another run's")))
        time.sleep(0.1)

    pool.jobs["u0"] = fall
    run(pool, 1, told=told)

    assert told == [
        ("worker-full", {"worker": "tcp://w", "memory_gib": 3.0}),
        ("worker-lost", {"worker": "tcp://w", "units": ["u0"]}),
    ]


def test_a_unit_that_filled_the_memory_of_workers_fails_with_that_reason():
    def fill(name):
        pool.inbox.put(WorkerMemoryFull("tcp://w", 3 << 30))
        pool.inbox.put(WorkerLost("tcp://w", (name,)))
        raise KilledError("four times")

    pool = Threads(size=1, jobs={"u0": fill})

    (failed, _) = sorted(run(pool, 2), key=lambda outcome: not outcome.error)

    assert failed.error == (
        "KilledError: four times (a worker that did it filled its memory)"
    )


def test_a_unit_that_failed_the_device_of_its_workers_fails_with_that_reason():
    def fail(name):
        pool.inbox.put(DeviceFailed(name, "CUDA error: an illegal memory access"))
        pool.inbox.put(DeviceFailed("another run's", "CUDA error"))
        raise KilledError("four times")

    def fail_once(name):
        if not name.endswith("-alone"):
            fail(name)

    told, pool = [], Threads(size=1, jobs={"u0": fail, "u1": fail_once})

    outcomes = {outcome.name: outcome.error for outcome in run(pool, 2, told=told)}

    reason = "CUDA error: an illegal memory access"
    assert outcomes == {
        "u0": f"KilledError: four times (it failed the device of its workers: {reason})",
        "play-k1-alone": "",
    }
    assert told == [
        ("device-failed", {"unit": unit, "reason": reason}) for unit in ("u0", "u1", "u0")
    ]


def test_a_unit_that_takes_too_long_fails_with_that_reason_and_is_not_tried_alone():
    def hang(name):
        pool.inbox.put(TimeLimitExceeded(name, 90.0))
        raise KilledError("its workers ended")

    told, pool = [], Threads(size=1, jobs={"u0": hang})

    (failed, _) = sorted(run(pool, 2, told=told), key=lambda outcome: not outcome.error)

    limit = "it took longer than --unit-timeout, 1.5 minutes"
    assert failed.error == f"KilledError: its workers ended ({limit})"
    assert told == [("unit-timeout", {"unit": "u0", "limit_min": 1.5})]


def test_progress_of_several_units_is_one_sum():
    heard, pool, both = [], Threads(size=2), threading.Barrier(2)

    def work(done, name):
        pool.inbox.put(TaskProgress(name, done, 32.0, "5 rollouts/s"))
        both.wait(10)
        time.sleep(0.1)

    pool.jobs = {f"u{at}": functools.partial(work, 8.0 * (at + 1)) for at in range(2)}
    run(pool, 2, heard=heard)

    assert heard[0] in ((8.0, 32.0, "5 rollouts/s"), (16.0, 32.0, "5 rollouts/s"))
    assert heard[1] == (0.75, 1.0, "2 at a time, one of them: 5 rollouts/s")
