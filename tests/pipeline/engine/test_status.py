from dataclasses import replace

import pytest

from pipeline.engine.locks import locked
from pipeline.engine.plan import PlanError
from pipeline.engine.registry import load_stage
from pipeline.engine.runner import RunOptions
from pipeline.engine.status import OTHER_CODE, stage_statuses


@pytest.fixture
def status(workshop):
    def look(*overrides, profile=None, **more):
        request = workshop.request(*overrides, profile=profile)
        found = stage_statuses(request.plan((), {}), request.made(), **more)
        return {standing.stage: standing for standing in found}

    return look


def told(found):
    return {name: (standing.state, standing.why) for name, standing in found.items()}


def test_on_an_empty_root_everything_is_missing(status):
    found = status()

    assert told(found) == dict.fromkeys(found, ("missing", "not made yet"))
    assert (found["count"].units, found["count"].made) == (2, 0)
    assert found["total"].units is None


def test_after_a_run_everything_is_cached(workshop, status):
    workshop.run()

    assert told(status()) == dict.fromkeys(("count", "total", "climb"), ("cached", ""))
    assert status()["count"].progress == "2/2"


def test_a_changed_setting_is_named_with_both_values(workshop, status):
    workshop.run()

    found = told(status("total.times=3"))

    assert found["count"] == ("cached", "")
    assert found["total"] == ("stale", "total.times 2.0 -> 3.0")
    assert found["climb"] == ("stale", "input total: total.times 2.0 -> 3.0")


def test_new_changed_and_removed_files_are_named(workshop, status):
    workshop.run()
    workshop.text("c.txt", "new")
    workshop.text("a.txt", "changed")
    (workshop.texts / "b.txt").unlink()

    found = told(status())

    files = "1 new file c.txt; 1 changed file a.txt; 1 removed file b.txt"
    assert found["count"] == ("stale", files)
    assert found["total"][1] == "; ".join(f"input count: {f}" for f in files.split("; "))
    assert found["climb"][1] == found["total"][1]


def test_many_files_are_counted_and_few_named(workshop, status):
    workshop.run()
    for letter in "pqrst":
        workshop.text(f"{letter}.txt", letter)

    expected = "5 new files p.txt, q.txt, r.txt, ...; 2 of 7 units made"
    assert told(status())["count"] == ("stale", expected)


def test_units_already_made_are_counted(workshop, status):
    workshop.text("c.txt", "fail")
    workshop.run(run_options=RunOptions(keep_going=True))
    workshop.text("c.txt", "well")

    assert told(status())["count"] == ("missing", "not made yet; 2 of 3 units made")


def test_a_failed_unit_is_named_with_its_error(workshop, status):
    workshop.text("a.txt", "fail")
    workshop.text("b.txt", "fail")
    workshop.run(run_options=RunOptions(keep_going=True))

    state, why = told(status())["count"]

    assert state == "failed"
    assert why == "a.txt: ValueError: a.txt says fail (and 1 more units)"


def test_other_settings_than_those_that_failed_are_not_failed(workshop, status):
    workshop.text("a.txt", "fail")
    workshop.run()

    assert told(status("count.longest=3"))["count"][0] == "missing"


def test_a_stage_being_made_is_running(workshop, status):
    with locked(workshop.root.lock("count")):
        state, why = told(status())["count"]

    assert state == "running"
    assert why.startswith("process ")


def test_a_raised_version_is_a_reason(workshop, status, monkeypatch):
    workshop.run()
    from_disk = workshop.plan()["count"].stage
    object.__setattr__(from_disk, "version", 2)

    assert told(status())["count"] == ("stale", "code version 1 -> 2")


def test_other_code_is_told_and_makes_stale_only_if_strict(workshop, status, monkeypatch):
    workshop.run()
    monkeypatch.setattr("pipeline.engine.status.code_hash", lambda modules: "other")

    assert told(status())["count"] == ("cached", OTHER_CODE)
    assert told(status(strict_code=True))["count"] == ("stale", OTHER_CODE)


def test_old_settings_that_were_made_before_are_cached_again(workshop, status):
    workshop.run()
    workshop.run("total.times=3")

    assert told(status())["total"] == ("cached", "")
    assert told(status("total.times=4"))["total"] == ("stale", "total.times 3.0 -> 4.0")


def test_the_comparison_is_with_the_last_run_under_the_same_profile(workshop, status):
    workshop.run("total.times=7")
    request = workshop.request(profile="short")
    request.remember(request.plan((), {}))

    found = told(status("total.times=8"))

    assert found["total"] == ("stale", "total.times 7.0 -> 8.0")


def test_a_stage_that_cannot_be_cut_says_why(workshop, status, monkeypatch):
    def refuse(inputs, settings):
        raise PlanError("there is nothing to count")

    stage = replace(load_stage("toy_count"), plan=refuse)
    monkeypatch.setattr("toy_count.STAGE", stage)

    assert told(status())["count"] == ("missing", "there is nothing to count")


def test_an_input_that_is_gone_is_said_to_differ(workshop, status):
    workshop.run()
    old = workshop.root.folder("count", workshop.plan()["count"].key)
    (old / "manifest.json").unlink()
    workshop.text("c.txt", "new")

    assert told(status())["total"] == ("stale", "input count: differs from what it was")
