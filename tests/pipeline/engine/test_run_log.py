import json

import pytest

from pipeline.engine.run_log import LogTail, RunLog


@pytest.fixture
def log(tmp_path):
    """``log(second, event, ...)`` adds a line to the log at ``log.path``."""

    def add(second, event, **figures):
        time = f"2026-01-01T00:{second // 60:02}:{second % 60:02}.000+00:00"
        line = json.dumps({"time": time, "event": event, **figures}) + "\n"
        with add.path.open("a") as file:
            file.write(line)

    add.path = tmp_path / "20260101T000000-7.jsonl"
    return add


NEW_YEAR_S = 1767225600.0


def test_a_log_is_read_on_from_where_it_was_left(log):
    tail = LogTail(log.path)
    assert list(tail.read()) == []  # Not there yet.

    log(0, "run-started")
    assert [event["event"] for event in tail.read()] == ["run-started"]
    assert list(tail.read()) == []
    log(1, "run-ended")
    assert [event["event"] for event in tail.read()] == ["run-ended"]
    log.path.unlink()
    assert list(tail.read()) == []


def test_half_a_line_waits_and_a_damaged_one_is_skipped(log):
    tail = LogTail(log.path)
    log.path.write_text('{"event": "run-started"}\nnonsense\n[1]\n{"event": "run')

    assert [event["event"] for event in tail.read()] == ["run-started"]
    with log.path.open("a") as file:
        file.write('-ended"}\n')
    assert [event["event"] for event in tail.read()] == ["run-ended"]


def test_a_run_is_followed_by_the_times_of_its_events(log):
    log(0, "run-started", workers="local:4")
    log(0, "stage-started", stage="count", units=10, made=2)
    for second in (4, 8, 12):
        log(second, "unit-done", stage="count")
    log(12, "unit-failed", stage="count")
    run = RunLog(log.path)

    run.follow(NEW_YEAR_S + 16)

    assert (run.stage, run.workers, run.failed) == ("count", "local:4", 1)
    assert run.meter.done == 6
    assert run.meter.per_s == pytest.approx(4 / 16)


def test_time_does_not_run_backwards_where_clocks_differ(log):
    log(0, "stage-started", stage="count", units=4, made=0)
    log(8, "unit-done", stage="count")
    run = RunLog(log.path)

    run.follow(NEW_YEAR_S - 3600)

    assert run.meter.per_s == pytest.approx(1 / 8)


def test_between_stages_and_after_a_run_there_is_no_gauge(log):
    log(0, "stage-started", stage="count", units=1, made=0)
    log(1, "stage-done", stage="count", report={})
    run = RunLog(log.path)
    run.follow(NEW_YEAR_S)
    assert (run.stage, run.meter) == ("", None)

    log(2, "stage-started", stage="total", units=1, made=0)
    run.follow(NEW_YEAR_S)
    assert run.stage == "total"
    log(3, "run-stopped", why="stopped by SIGINT")
    log(4, "progress", stage="total", done=1, total=2, note="")
    run.follow(NEW_YEAR_S)
    assert run.meter is None
