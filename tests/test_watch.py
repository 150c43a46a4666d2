"""``infgen status --watch`` beside pipelines that really run, in processes of their own."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).parent
STAGES = """\
version: 1
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  climb: {module: toy_climb, deps: [total], params: [climb]}
  total: {module: toy_total, deps: [count], params: [total]}
"""
PATIENCE_S = 60


@pytest.fixture
def start(tmp_path):
    """``start("status", ...)`` starts ``infgen`` beside a folder of three texts."""
    (tmp_path / "stages.yaml").write_text(STAGES)
    (tmp_path / "texts").mkdir()
    for name in "abc":
        (tmp_path / f"texts/{name}.txt").write_text(f"some words of {name}")
    path = os.pathsep.join([str(HERE.parent), str(HERE / "pipeline" / "toys")])
    started = []

    def infgen(*words, stdout=subprocess.PIPE):
        process = subprocess.Popen(
            [sys.executable, "-m", "infgen", *words],
            cwd=tmp_path,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "COLUMNS": "120", "TERM": "xterm"},
        )
        started.append(process)
        return process

    yield infgen
    for process in started:
        process.kill()
        process.communicate()


RUN = ("run", "--root", "R", "--records", "texts/*.txt")
WATCH = ("status", "--root", "R", "--watch", "--every", "0.1")


def looks_until(process, is_it):
    """Read looks, a line of JSON each, until one is what is waited for."""
    deadline = time.monotonic() + PATIENCE_S
    for line in process.stdout:
        look = json.loads(line)
        if is_it({row["stage"]: row for row in look["rows"]}):
            return look
        assert time.monotonic() < deadline, look
    raise AssertionError(f"it ended: {process.communicate()}")


def ends(process, number=signal.SIGINT):
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in err
    return process.returncode


def test_a_watcher_sees_a_run_begin_go_on_and_end(start):
    watching = start(*WATCH, "--json")
    looks_until(watching, lambda rows: not rows)  # There is no root yet.
    running = start(*RUN, "-s", "count.sleep_s=1", "-s", "climb.sleep_s=0.5")

    looks_until(watching, lambda rows: rows.get("count", {}).get("state") == "running")
    half = looks_until(watching, lambda rows: (rows["count"]["done"] or 0) >= 2)
    looks_until(
        watching,
        lambda rows: (rows["climb"]["state"], rows["climb"]["at_work"]) == ("running", 1),
    )
    last = looks_until(
        watching, lambda rows: all(row["state"] == "cached" for row in rows.values())
    )

    row = half["rows"][0]
    assert (row["stage"], row["units"]) == ("count", 3)
    assert 0 < row["per_s"] < 3
    assert 0 < row["remaining_s"] < 10
    assert row["memory_bytes"] > 10 << 20
    assert row["run"].startswith(f"process {running.pid} on ")
    assert not last["trouble"]
    assert running.wait(PATIENCE_S) == 0
    assert ends(watching) == 130


def test_a_killed_run_is_seen_to_be_gone(start):
    running = start(*RUN, "-s", "count.sleep_s=30")
    watching = start(*WATCH, "--json")
    looks_until(watching, lambda rows: rows.get("count", {}).get("state") == "running")
    running.kill()

    look = looks_until(watching, lambda rows: rows["count"]["state"] != "running")

    assert look["rows"][0]["state"] == "missing"
    assert ends(watching, signal.SIGTERM) == 143


def test_with_check_watching_ends_with_what_it_watches(start):
    running = start(*RUN, "-s", "count.sleep_s=1")
    looking = start(*WATCH, "--json")
    looks_until(looking, lambda rows: rows.get("count", {}).get("state") == "running")
    watching = start(*WATCH[:-1], "0.5", "--check")
    out, err = watching.communicate(timeout=PATIENCE_S)

    assert running.wait(PATIENCE_S) == 0
    assert watching.returncode == 0
    assert err == ""
    lines = [line[9:] for line in out.splitlines()]
    assert any(line.startswith("count: running, ") for line in lines)
    assert f"process {running.pid} on " in out


def test_on_a_terminal_the_table_is_drawn_in_place(start):
    assert start(*RUN).wait(PATIENCE_S) == 0
    ours, theirs = pty.openpty()
    watching = start(*WATCH, stdout=theirs)
    os.close(theirs)
    seen, deadline = "", time.monotonic() + PATIENCE_S
    while seen.count("stages at") < 3 and time.monotonic() < deadline:
        seen += os.read(ours, 1 << 16).decode()

    assert ends(watching) == 130
    os.close(ours)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", seen)
    assert re.search(r"count +cached +3 of 3", plain)
    assert "\x1b[1A" in seen  # Back up, to draw over what was there.
    assert "\x1b[?25h" in seen or "\x1b[?25l" in seen


def test_with_check_a_root_where_something_is_not_made_is_exit_code_3(start):
    watching = start(*WATCH, "--check", *RUN[3:])
    out, _ = watching.communicate(timeout=PATIENCE_S)

    assert watching.returncode == 3
    assert "count: missing, 0 of 3, not made yet" in out
