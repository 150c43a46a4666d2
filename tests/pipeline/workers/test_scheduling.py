"""Handing out units, with a crew of threads instead of machines."""

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
    Broken,
    ByCrew,
    Ended,
    Full,
    Lost,
    Share,
)


class KilledError(Exception):
    pass


@dataclass
class Threads:
    """A crew of threads. ``jobs`` say what a unit does besides being done."""

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
        future.add_done_callback(lambda _: self.inbox.put(Ended(name)))

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
            return Broken(error, "", isinstance(error, KilledError))
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


def run(crew, count, go_on=lambda: True, told=None, heard=None):
    def progress(done, total, note=""):
        (heard if heard is not None else []).append((done, total, note))

    def tell(event, **figures):
        (told if told is not None else []).append((event, figures))

    return list(ByCrew(crew).run(tasks(count), go_on, progress, tell))


def test_never_more_than_two_tasks_a_thread_are_handed_out():
    crew = Threads(size=3)

    outcomes = run(crew, 5500)  # All of validation, eight scenes a unit.

    assert len(outcomes) == 5500
    assert 3 <= crew.most <= 6


def test_tasks_are_begun_in_order():
    crew = Threads(size=1)

    run(crew, 5)

    assert crew.begun == [f"play-k{at}" for at in range(5)]


def test_none_is_begun_once_it_is_not_to_go_on():
    crew, asked = Threads(size=1), []

    def go_on():
        asked.append(None)
        return len(asked) <= 3

    assert len(run(crew, 100, go_on)) == len(crew.begun) <= 3


def die(names, name):
    if name in names:
        raise KilledError(name)


def test_who_was_beside_a_killer_is_done_in_the_end_alone():
    # Unit 1 kills its worker each time; unit 2 is on the same worker the first time.
    jobs = {
        "u1": functools.partial(die, {"play-k1", "play-k1-alone"}),
        "u2": functools.partial(die, {"play-k2"}),
    }
    crew = Threads(size=2, jobs=jobs)

    outcomes = {outcome.name: outcome for outcome in run(crew, 6)}

    assert outcomes["u1"].error == "KilledError: play-k1-alone"
    assert "play-k2-alone" in outcomes, "it is done"
    assert len(outcomes) == 6
    assert crew.begun[-2:] == ["play-k1-alone", "play-k2-alone"]


def test_other_errors_are_not_tried_again():
    def fail(name):
        raise ValueError("bad")

    crew = Threads(jobs={"u0": fail})

    assert [each.error for each in run(crew, 2)].count("ValueError: bad") == 1
    assert crew.begun == ["play-k0", "play-k1"]


def test_a_crew_that_is_lost_ends_the_run_at_once():
    def lose(name):
        raise WorkersLostError("gone")

    with pytest.raises(WorkersLostError, match="gone"):
        run(Threads(jobs={"u1": lose}), 10)


def test_a_crew_that_does_not_answer_ends_the_run(monkeypatch):
    monkeypatch.setattr(scheduling, "LOOK_S", 0.05)
    crew = Threads()

    def hang(name):
        crew.lost = True
        time.sleep(0.5)

    crew.jobs["u0"] = hang
    with pytest.raises(WorkersLostError, match="lost"):
        run(crew, 3)


def test_without_workers_a_run_waits_for_some_time(monkeypatch):
    monkeypatch.setattr(scheduling, "LOOK_S", 0.02)
    monkeypatch.setattr(scheduling, "NOBODY_S", 0.2)
    told, crew = [], Threads(size=0, jobs={"u0": lambda name: time.sleep(1)})

    with pytest.raises(WorkersLostError, match=r"no worker for 0.00333333 minutes"):
        run(crew, 1, told=told)

    assert [event for event, _ in told] == ["workers-missing"]


def test_a_cluster_that_grows_is_given_more(monkeypatch):
    monkeypatch.setattr(scheduling, "LOOK_S", 0.02)
    crew = Threads(size=1)
    crew._pool = ThreadPoolExecutor(8)

    def grow(name):
        crew.size = 4
        time.sleep(0.1)

    crew.jobs = {f"u{at}": grow for at in range(20)}
    run(crew, 20)

    assert 2 < crew.most <= 8


def test_what_happens_to_workers_is_told():
    told, crew = [], Threads(size=1)

    def fall(name):
        crew.inbox.put(Full("tcp://w", 3 << 30))
        crew.inbox.put(Lost("tcp://w", (name, "another run's")))
        time.sleep(0.1)

    crew.jobs["u0"] = fall
    run(crew, 1, told=told)

    assert told == [
        ("worker-full", {"worker": "tcp://w", "memory_gib": 3.0}),
        ("worker-lost", {"worker": "tcp://w", "units": ["u0"]}),
    ]


def test_a_unit_that_filled_the_memory_of_workers_fails_with_that_reason():
    def fill(name):
        crew.inbox.put(Full("tcp://w", 3 << 30))
        crew.inbox.put(Lost("tcp://w", (name,)))
        raise KilledError("four times")

    crew = Threads(size=1, jobs={"u0": fill})

    (failed, _) = sorted(run(crew, 2), key=lambda outcome: not outcome.error)

    assert failed.error == (
        "KilledError: four times (a worker that did it filled its memory)"
    )


def test_progress_of_several_units_is_one_sum():
    heard, crew, both = [], Threads(size=2), threading.Barrier(2)

    def work(done, name):
        crew.inbox.put(Share(name, done, 32.0, "5 rollouts/s"))
        both.wait(10)
        time.sleep(0.1)

    crew.jobs = {f"u{at}": functools.partial(work, 8.0 * (at + 1)) for at in range(2)}
    run(crew, 2, heard=heard)

    assert heard[0] in ((8.0, 32.0, "5 rollouts/s"), (16.0, 32.0, "5 rollouts/s"))
    assert heard[1] == (0.75, 1.0, "2 at a time, one of them: 5 rollouts/s")
