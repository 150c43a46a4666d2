"""A clock that jumps back, as of a virtual machine that is set to the time of its host."""

import json
import os
from datetime import UTC, datetime, timedelta

import pytest

from pipeline.engine import events as engine_events
from pipeline.engine.events import Events
from pipeline.engine.garbage import find_garbage
from pipeline.engine.run_log import RunLog
from pipeline.engine.runner import RunOptions, run

NOON = datetime(2026, 11, 24, 12, tzinfo=UTC)


class FallingClock:
    """A clock of which every look is an hour earlier than the one before."""

    looks = 0

    @classmethod
    def now(cls, zone):
        cls.looks += 1
        return NOON - timedelta(hours=cls.looks)


@pytest.fixture
def falling(monkeypatch):
    monkeypatch.setattr(engine_events, "datetime", FallingClock)
    monkeypatch.setattr(FallingClock, "looks", 0)


def test_a_run_makes_the_same_and_its_log_is_read_in_order(workshop, expected, falling):
    results = workshop.run()

    assert {result.state for result in results.values()} == {"made"}
    assert workshop.files() == expected
    (log,) = workshop.root.logs.iterdir()
    events = [json.loads(line)["event"] for line in log.read_text().splitlines()]
    assert (events[0], events[-1]) == ("run-started", "run-ended")


def test_a_run_is_watched_without_rates_below_zero(workshop, falling):
    emitted = Events(workshop.root)
    emitted.emit("stage-started", stage="count", units=9, made=0)
    watched, rates = RunLog(emitted.log), []
    for unit in range(5):
        emitted.emit("unit-done", stage="count", unit=str(unit))
        watched.follow((NOON - timedelta(hours=100)).timestamp())
        rates.append((watched.meter.per_s, watched.meter.remaining_s))

    assert watched.meter.done == 5
    assert all(value is None or value >= 0 for pair in rates for value in pair)


def test_what_seems_to_be_written_in_the_future_is_no_garbage(workshop, monkeypatch):
    workshop.run()
    partial = workshop.root.units("count") / "0123456789abcdef.cafe.partial"
    partial.mkdir()
    monkeypatch.setattr("time.time", lambda: 0.0)

    assert find_garbage(workshop.root) == []


def test_a_file_with_an_older_time_than_before_is_read_again(workshop):
    workshop.run()
    path = workshop.text("a.txt", "one two three four five")
    os.utime(path, ns=(1, 1))

    results = workshop.run()

    assert results["count"].made == 1
    assert run(workshop.plan(), RunOptions(), Events(workshop.root))[0].state == "cached"
