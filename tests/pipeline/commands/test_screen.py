import re

import pytest
from rich.console import Console

from pipeline.commands.screen import LiveTable, Screen, gibibytes, show_table

STARTED = {"event": "stage-started", "stage": "count", "key": "k", "units": 3, "made": 1}
DONE = {"event": "unit-done", "stage": "count", "unit": "a", "seconds": 1.0, "report": {}}
ENDED = {"event": "stage-done", "stage": "count", "report": {"words": 6}}


def test_without_a_terminal_there_is_a_line_per_stage_and_no_bar(capsys):
    with Screen() as screen:
        for event in (STARTED, DONE, DONE, ENDED):
            screen(event)

    out, err = capsys.readouterr()
    assert out == ""
    lines = [line[9:] for line in err.splitlines()]
    assert lines == ["count: 3 units, 1 of them made before", "count: made; words 6"]


def test_progress_is_told_at_most_every_ten_seconds(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with Screen() as screen:
        screen(STARTED)
        for _ in range(100):
            now[0] += 0.25
            screen({"event": "progress", "done": 1, "total": 4, "note": ""})

    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 + 2
    assert "count: 1.25 of 3 units" in lines[1]


def test_with_a_terminal_there_is_a_bar(monkeypatch):
    console = Console(force_terminal=True, width=100, record=True)
    monkeypatch.setattr("pipeline.commands.screen.Console", lambda **words: console)
    with Screen() as screen:
        for event in (STARTED, DONE, ENDED):
            screen(event)

    text = console.export_text()
    assert "count: made; words 6" in text
    assert "2 of 3 units" in text


def test_failures_are_told_with_their_reason(capsys):
    with Screen() as screen:
        screen(STARTED)
        about = {"stage": "count", "unit": "a", "seconds": 1.0, "trace": ""}
        screen({"event": "unit-failed", "error": "ValueError: [x]", **about})

    assert "count: unit a failed: ValueError: [x]" in capsys.readouterr().err


def test_tables_show_cells_as_they_are(capsys):
    show_table("title", ("a", "b"), [(1, "[bold]x"), (0.123456, None)])

    out = capsys.readouterr().out
    assert "title" in out
    assert "[bold]x" in out
    assert "0.1235" in out


def test_a_title_wider_than_its_table_stays_in_one_line(capsys):
    show_table("0.0 MB to remove with --yes", ("a", "b"), [])

    assert "0.0 MB to remove with --yes" in capsys.readouterr().out


@pytest.mark.parametrize(("count", "words"), [(1500, "0.0 MB"), (3 << 30, "3.00 GiB")])
def test_bytes_are_written_for_people(count, words):
    assert gibibytes(count) == words


@pytest.fixture
def terminal(monkeypatch):
    console = Console(force_terminal=True, width=60, record=True)
    monkeypatch.setattr("pipeline.commands.screen.Console", lambda **words: console)
    return console


def test_a_live_table_is_drawn_in_place_and_cuts_its_last_column(terminal):
    with LiveTable() as table:
        for done in (1, 2):
            row = ("count", "running", f"{done} of 3", "[loss] " + 30 * "long ")
            table.draw("stages", ("stage", "state", "done", "note"), [row], "process 1")

    text = terminal.export_text()
    assert table.alive
    assert {"1 of 3", "2 of 3"} <= set(re.findall(r"\d of 3", text))
    assert "[loss] long" in text
    assert max(len(line) for line in text.splitlines() if "loss" in line) <= 60
    assert "process 1" in text


def test_without_a_terminal_states_are_told_at_once_and_figures_now_and_then(
    capsys, monkeypatch
):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with LiveTable() as table:
        table.draw("stages", ("stage",), [("count",)], "")
        for second in range(25):
            now[0] = float(second)
            table.tell("count", "running", f"running, {second} of 99")
        table.tell("count", "cached", "cached")
        table.tell("", "", "")

    lines = [line[9:] for line in capsys.readouterr().out.splitlines()]
    assert not table.alive
    assert lines == [
        "count: running, 0 of 99",
        "count: running, 10 of 99",
        "count: running, 20 of 99",
        "count: cached",
    ]
