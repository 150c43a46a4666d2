import json
import os
import shutil
from dataclasses import replace
from socket import gethostname

import pytest

from infgen.errors import ConfigError
from pipeline.commands import watch
from pipeline.commands.watch import NOTHING_YET, Watcher
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.locks import locked
from pipeline.engine.registry import load_stage
from pipeline.engine.runner import RunOptions
from pipeline.settings.request import complete_request


@pytest.fixture
def watcher(workshop):
    return Watcher(workshop.request, {})


def rows(look):
    assert not look.trouble
    return {row.stage: row for row in look.rows}


def test_a_root_without_any_run_is_waited_for(tmp_path):
    def ask():
        known = {"file": None, "profile": None, "records": (), "overrides": ()}
        return complete_request(Root(tmp_path / "none"), **known, environ={})

    look = Watcher(ask, {}).look()

    assert (look.rows, look.trouble, look.running) == ((), NOTHING_YET, False)
    assert not (tmp_path / "none").exists()


def test_a_finished_root_is_cached_and_nothing_runs(workshop, watcher):
    workshop.run()

    look = watcher.look()

    assert not look.running
    found = rows(look)
    assert {row.state for row in found.values()} == {"cached"}
    assert (found["count"].done, found["count"].units) == (2, 2)


def test_failures_of_the_last_run_are_counted_and_one_is_told(workshop, watcher):
    for name in ("a.txt", "b.txt"):
        workshop.text(name, "fail")
    workshop.text("c.txt", "well")
    workshop.run(run_options=RunOptions(keep_going=True))

    row = rows(watcher.look())["count"]

    assert (row.state, row.failed, row.done, row.units) == ("failed", 2, 1, 3)
    assert row.note.startswith("a.txt: ValueError: a.txt says fail")


@pytest.fixture
def making(workshop, monkeypatch):
    """A stage under way in this process, as its files tell: ``making.told(event, ...)``."""
    workshop.run(targets=("total",))
    plan = workshop.plan()
    key = plan["climb"].key
    root, stage = workshop.root, workshop.root.stage("climb")
    events = Events(root)
    monkeypatch.setattr("pipeline.engine.events.QUIET_S", 0.0)
    units = root.units("climb")
    (units / f"{'a' * 16}.partial").mkdir(parents=True)
    (units / f"{'f' * 16}.12345678.partial").mkdir()  # Of someone else.
    attempt = {"key": key, "failed": {}, "units": {"x": "a" * 64, "y": "b" * 64}}
    (stage / "attempt.json").write_text(json.dumps(attempt))
    with locked(root.lock("climb")):
        events.emit("run-started", stages=["climb"], workers="local:2")
        events.emit("stage-started", stage="climb", key=key, units=1, made=0)
        yield events.emit


def test_a_running_stage_tells_all_there_is_to_know(making, watcher):
    making("unit-failed", stage="climb", unit="x", error="E: x", trace="")
    making("progress", stage="climb", done=10, total=50, note="height 9")
    watcher.look()
    making("progress", stage="climb", done=30, total=50, note="height 29")

    look = watcher.look()

    row = rows(look)["climb"]
    assert look.running
    assert (row.state, row.done, row.units, row.what) == ("running", 30, 50, "steps")
    assert row.per_s > 0
    assert row.remaining_s == pytest.approx(20 / row.per_s)
    assert (row.at_work, row.failed, row.note) == (1, 1, "height 29")
    assert row.memory_bytes > 1 << 20
    assert row.run.startswith(f"process {os.getpid()} on {gethostname()} since ")
    assert row.run.endswith("workers local:2")


def test_a_run_on_another_machine_has_no_memory_here(making, watcher, monkeypatch):
    monkeypatch.setattr(watch, "gethostname", lambda: "elsewhere")

    assert rows(watcher.look())["climb"].memory_bytes is None


def test_a_running_stage_whose_log_is_gone_still_runs(making, workshop, watcher):
    shutil.rmtree(workshop.root.logs)

    row = rows(watcher.look())["climb"]

    assert (row.state, row.per_s, row.failed) == ("running", None, 0)


def test_what_units_set_aside_is_added_up_as_they_are_made(workshop, watcher, monkeypatch):
    toy = load_stage("toy_count")

    def work(unit, target, settings, progress):
        if unit.name == "c.txt":
            raise ValueError("not this one")
        return {**toy.work(unit, target, settings, progress), "quarantined": 3}

    stage = replace(toy, work=work)
    monkeypatch.setattr("toy_count.STAGE", stage)
    workshop.text("c.txt", "more")
    workshop.run(run_options=RunOptions(keep_going=True))

    found = rows(watcher.look())

    assert found["count"].quarantined == 6
    assert found["total"].quarantined is None


def test_trouble_leaves_the_last_table_standing(workshop, watcher):
    workshop.run()
    before = watcher.look().rows
    shutil.move(workshop.texts, workshop.folder / "away")
    look = watcher.look()

    assert look.rows == before
    assert "no records match" in look.trouble
    shutil.move(workshop.folder / "away", workshop.texts)
    assert watcher.look().trouble == ""


def test_damage_is_told_from_the_first_look_on(workshop, watcher):
    workshop.run()
    (manifest,) = workshop.root.stage("count").glob("*/manifest.json")
    manifest.write_text("{")

    look = watcher.look()

    assert look.rows == ()
    assert "manifest.json is damaged" in look.trouble


def test_wrong_words_are_an_error_at_the_first_look(workshop):
    request = workshop.request("count.longets=3")
    watcher = Watcher(lambda: request, {})

    with pytest.raises(ConfigError, match="did you mean 'longest'"):
        watcher.look()


def test_looking_changes_nothing_on_disk(making, workshop, watcher):
    def state():
        return {
            path: (path.stat().st_mtime_ns, path.is_file() and path.read_bytes())
            for path in sorted(workshop.root.path.rglob("*"))
        }

    watcher.look()
    before = state()
    watcher.look()

    assert state() == before
