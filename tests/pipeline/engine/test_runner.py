import json
import os
import shutil
from dataclasses import replace

import pytest
import torch

from pipeline.commands.verbs import exit_code
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.locks import LockedError, locked
from pipeline.engine.machine import describe
from pipeline.engine.manifest import read_manifest, verify
from pipeline.engine.plan import PlanError
from pipeline.engine.registry import load_stage
from pipeline.engine.runner import RunOptions
from pipeline.engine.stage import Unit
from pipeline.engine.units import DeviceLostError, device_failure


def states(results):
    return {name: result.state for name, result in results.items()}


def test_a_first_run_makes_everything_and_a_second_finds_it(workshop):
    first = workshop.run()
    second = workshop.run()

    assert set(states(first).values()) == {"made"}
    assert set(states(second).values()) == {"cached"}
    assert [second[name].made for name in second] == [0, 0, 0]
    assert {n: r.report for n, r in first.items()} == {
        n: r.report for n, r in second.items()
    }


def test_the_figures_are_those_of_the_texts(workshop):
    results = workshop.run()

    assert results["count"].report == {"files": 2, "words": 6}
    assert results["total"].report == {"total": 2 * (15 + 10)}


def test_a_new_file_makes_only_its_own_units(workshop):
    workshop.run()
    workshop.text("c.txt", "dolor")

    results = workshop.run()

    assert (results["count"].made, results["count"].units) == (1, 3)
    assert (results["total"].made, results["total"].units) == (1, 3)


def test_a_changed_file_makes_only_its_own_units(workshop):
    workshop.run()
    workshop.text("b.txt", "lorem ipsum dolor")

    assert workshop.run()["count"].made == 1


def test_a_setting_makes_its_stage_and_those_after_it_again(workshop):
    workshop.run()

    results = workshop.run("total.times=3")

    assert states(results) == {"count": "cached", "total": "made", "climb": "made"}


def test_going_back_to_old_settings_costs_nothing(workshop):
    workshop.run()
    workshop.run("total.times=3")

    results = workshop.run()

    assert set(states(results).values()) == {"cached"}
    folder = workshop.root.latest_folder("total")
    assert json.loads((folder / "total.json").read_text()) == 50.0


def test_a_stage_that_comes_out_the_same_spares_what_reads_its_content(workshop):
    workshop.run()
    workshop.text("empty.txt", "")  # Changes every key, but not the total.

    results = workshop.run()

    assert results["climb"].state == "made"
    assert results["climb"].made == 0


def moved(workshop, tmp_path):
    """The same workshop in another folder."""
    return type(workshop)(
        workshop.folder.rename(tmp_path.with_name(f"{tmp_path.name}-moved"))
    )


def test_a_moved_root_and_moved_sources_are_still_up_to_date(workshop, tmp_path):
    workshop.run()

    assert set(states(moved(workshop, tmp_path).run()).values()) == {"cached"}


def test_artefacts_are_the_same_bytes_in_any_root(workshop, tmp_path):
    workshop.run()
    first = workshop.files()
    shutil.rmtree(workshop.root.path)
    elsewhere = moved(workshop, tmp_path)
    elsewhere.run()

    assert elsewhere.files() == first
    assert any(name.endswith("manifest.json") for name in first)


def test_force_makes_the_named_stage_and_those_after_it_again(workshop):
    workshop.run()
    before = workshop.files()

    results = workshop.run(run_options=RunOptions(force=frozenset({"total"})))

    assert states(results) == {"count": "cached", "total": "made", "climb": "made"}
    assert results["total"].made == 2
    assert workshop.files() == before


def test_a_failed_unit_stops_the_run_and_names_the_reason(workshop):
    workshop.text("a.txt", "fail")
    events = []

    results = workshop.run(events=events)

    assert states(results) == {"count": "failed", "total": "skipped", "climb": "skipped"}
    assert results["count"].errors == {"a.txt": "ValueError: a.txt says fail"}
    assert results["count"].made == 0
    (failed,) = [event for event in events if event["event"] == "unit-failed"]
    assert "toy_count.py" in failed["trace"]


def test_keep_going_makes_the_other_units(workshop):
    workshop.text("a.txt", "fail")

    results = workshop.run(run_options=RunOptions(keep_going=True))

    assert results["count"].made == 1
    assert list(results["count"].errors) == ["a.txt"]
    assert states(results)["total"] == "skipped"


def test_the_next_run_tries_failed_units_again_and_only_those(workshop):
    workshop.text("a.txt", "fail")
    workshop.run(run_options=RunOptions(keep_going=True))
    workshop.text("a.txt", "well")

    results = workshop.run()

    assert set(states(results).values()) == {"made"}
    assert results["count"].made == 1
    assert not workshop.root.attempt("count").exists()


def test_a_finish_that_fails_leaves_its_units_and_is_tried_again(workshop):
    results = workshop.run("total.refuse=true")

    assert states(results)["total"] == "failed"
    assert results["total"].errors == {"finish": "ValueError: told to refuse"}
    assert results["total"].made == 2
    assert workshop.run("total.refuse=true")["total"].made == 0


def test_a_failed_unit_leaves_nothing_behind(workshop):
    workshop.text("a.txt", "fail")
    workshop.run(run_options=RunOptions(keep_going=True))

    assert not list(workshop.root.store.rglob("*.partial"))


def test_what_a_killed_run_left_is_cleared(workshop):
    left = workshop.root.units("count") / "0123456789abcdef.dead.partial"
    left.mkdir(parents=True)
    (left / "half.txt").write_text("half")

    workshop.run()

    assert not left.exists()


def half_removed(folder):
    """What a kill leaves of a folder that was being removed, its manifest first."""
    (folder / MANIFEST).unlink()
    return folder


def test_a_unit_that_was_half_removed_is_made_again(workshop):
    workshop.run()
    unit = next(iter(read_manifest(workshop.root.latest_folder("count"))["units"]))
    half_removed(workshop.root.unit("count", unit["key"]))
    half_removed(workshop.root.latest_folder("count"))

    results = workshop.run()

    assert states(results)["count"] == "made"
    assert results["count"].made == 1
    assert set(states(workshop.run()).values()) == {"cached"}
    assert list(verify(workshop.root, full=True)) == []


def test_a_stage_that_was_half_removed_is_made_again(workshop):
    workshop.run()
    half_removed(workshop.root.latest_folder("count"))

    assert states(workshop.run())["count"] == "made"
    assert states(workshop.run())["count"] == "cached"


def test_a_kill_while_folders_are_removed_leaves_none_half_removed(workshop, monkeypatch):
    workshop.run()
    before = workshop.files()

    def die(path, **how):
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", die)
        with pytest.raises(SystemExit):
            workshop.run(run_options=RunOptions(force=frozenset({"count"})))

    workshop.run()

    assert workshop.files() == before


def test_a_worker_of_a_dead_run_that_still_writes_is_no_hindrance(workshop, monkeypatch):
    left = workshop.root.units("count") / "0123456789abcdef.dead.partial"
    left.mkdir(parents=True)
    working = os.open(left, os.O_RDONLY)
    remove, tries = os.rmdir, []

    def write_first(name, **where):
        if os.path.samestat(os.fstat(working), os.stat(name, **where)) and not tries:
            tries.append((left.exists(), name))
            os.close(os.open("late.txt", os.O_CREAT, dir_fd=working))
        remove(name, **where)

    monkeypatch.setattr(os, "rmdir", write_first)

    assert states(workshop.run())["count"] == "made"

    os.close(working)
    assert [there for there, _ in tries] == [False]  # Nobody finds it by its name.
    assert not list(workshop.root.store.rglob("*.partial"))


def test_a_resuming_stage_goes_on_where_it_was(workshop):
    workshop.run("climb.killed_at=3")
    results = workshop.run("climb.killed_at=3")

    begun = (workshop.root.stage("climb") / "begun-at").read_text().split()
    assert begun == ["0", "3"]
    assert results["climb"].state == "made"


def test_force_begins_a_resuming_stage_anew(workshop):
    workshop.run("climb.killed_at=3")
    workshop.run("climb.killed_at=-1", run_options=RunOptions(force=frozenset({"climb"})))

    begun = (workshop.root.stage("climb") / "begun-at").read_text().split()
    assert begun == ["0", "0"]


def test_a_locked_stage_is_not_touched(workshop):
    with (
        locked(workshop.root.lock("count")),
        pytest.raises(LockedError, match=str(os.getpid())),
    ):
        workshop.run()


def test_a_whole_stage_needs_no_lock(workshop):
    workshop.run()

    with locked(workshop.root.lock("count")):
        assert workshop.run()["count"].state == "cached"


def test_manifests_hold_what_made_them_and_verify_finds_all_well(workshop):
    workshop.run()
    folder = workshop.root.latest_folder("count")
    manifest = read_manifest(folder)

    assert manifest["settings"] == {"count": {"longest": 100, "sleep_s": 0.0}}
    assert list(manifest["sources"]) == ["a.txt", "b.txt"]
    assert [unit["name"] for unit in manifest["units"]] == ["a.txt", "b.txt"]
    unit = read_manifest(workshop.root.unit("count", manifest["units"][0]["key"]))
    assert unit["task"] == {"url": None}
    assert "count.json" in unit["files"]
    assert "run" not in unit["report"]
    assert list(verify(workshop.root, full=True)) == []


def test_what_varies_between_runs_is_kept_apart(workshop):
    workshop.run()
    manifest = read_manifest(workshop.root.latest_folder("count"))
    unit = workshop.root.unit("count", manifest["units"][0]["key"])

    about = json.loads((unit / "run.json").read_text())

    assert set(about) == {"host", "machine", "report", "seconds", "started"}
    assert about["machine"]["cores"] == os.cpu_count()
    assert "letters_per_s" in about["report"]


def test_latest_and_report_lead_to_what_was_made_or_found(workshop):
    first = workshop.run()
    workshop.run("total.times=3")

    workshop.run()

    link = workshop.root.latest / "total"
    assert not os.path.isabs(os.readlink(link))
    assert link.resolve().name == first["total"].key[:16]


def test_other_code_makes_again_only_if_told_to(workshop, monkeypatch):
    workshop.run()
    monkeypatch.setattr("pipeline.engine.status.code_hash", lambda modules: "other")

    assert workshop.run()["count"].state == "cached"
    assert workshop.run(run_options=RunOptions(strict_code=True))["count"].state == "made"


@pytest.mark.parametrize("names", [("a", "a"), ("a/b",), ("",)])
def test_bad_unit_names_are_refused(workshop, monkeypatch, names):
    units = [Unit(name, {}, {}) for name in names]
    toy = load_stage("toy_count")
    stage = replace(toy, plan=lambda inputs, settings: units)
    monkeypatch.setattr("pipeline.engine.plan.load_stage", lambda module: stage)

    with pytest.raises(PlanError, match="unit with a bad or repeated name"):
        workshop.run(targets=("count",))


def test_every_event_is_a_line_of_the_log(workshop):
    workshop.run()

    (log,) = workshop.root.logs.glob("*.jsonl")
    events = [json.loads(line) for line in log.read_text().splitlines()]
    names = [event["event"] for event in events]
    assert names[0] == "run-started"
    assert names[-1] == "run-ended"
    assert names.count("unit-done") == 5
    assert "progress" not in names


def test_progress_is_logged_where_the_log_was_silent_for_long(workshop, monkeypatch):
    monkeypatch.setattr("pipeline.engine.events.QUIET_S", 0.0)

    workshop.run(targets=("count",))

    (log,) = workshop.root.logs.glob("*.jsonl")
    events = [json.loads(line) for line in log.read_text().splitlines()]
    told = [(e["done"], e["total"]) for e in events if e["event"] == "progress"]
    assert told == [(1, 3), (2, 3), (3, 3)] * 2


def test_a_failed_device_ends_the_run_instead_of_failing_unit_after_unit(
    workshop, monkeypatch
):
    monkeypatch.setitem(describe(), "gpus", ["NVIDIA H100 80GB HBM3"])
    workshop.text("b.txt", "assert-once")
    workshop.text("c.txt", "never begun")
    events = []

    with pytest.raises(DeviceLostError) as lost:
        workshop.run(run_options=RunOptions(keep_going=True), events=events)

    assert "unit b.txt: the device" in str(lost.value)
    assert f"{os.uname().nodename}: NVIDIA H100 80GB HBM3) failed" in str(lost.value)
    assert "AcceleratorError: CUDA error: device-side assert triggered;" in str(lost.value)
    assert exit_code(lost.value) == 1
    ends = [
        event["event"] for event in events if event["event"].startswith(("unit", "run"))
    ]
    assert ends == ["run-started", "unit-done", "run-stopped"]
    assert workshop.run()["count"].made == 2, "what was done is kept"


def chained(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (
            torch.AcceleratorError("CUDA error: unspecified launch failure\nMore."),
            "AcceleratorError: CUDA error: unspecified launch failure",
        ),
        (
            RuntimeError("CUDA error: CUBLAS_STATUS_EXECUTION_FAILED"),
            "RuntimeError: CUDA error: CUBLAS_STATUS_EXECUTION_FAILED",
        ),
        (
            chained(ValueError("a file"), torch.AcceleratorError("CUDA error: x")),
            "AcceleratorError: CUDA error: x",
        ),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), ""),
        (ValueError("the log of a CUDA error: x"), ""),
        (RuntimeError("mat1 and mat2 shapes cannot be multiplied"), ""),
    ],
)
def test_errors_after_which_a_device_refuses_all_work_are_told_from_others(error, reason):
    assert device_failure(error) == reason
