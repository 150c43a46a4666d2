import os
import shutil
import sys

import pytest

from pipeline.engine.atomic import remove_folder
from pipeline.engine.garbage import PARTIAL_AGE_S, find_garbage, remove_garbage
from pipeline.engine.locks import LockedError, locked
from pipeline.engine.runner import RunOptions
from pipeline.settings.request import named_weights


def kinds(garbage):
    return sorted(each.why for each in garbage)


def test_after_one_run_there_is_no_garbage(workshop):
    workshop.run()

    assert find_garbage(workshop.root) == []


def test_what_the_latest_run_replaced_is_garbage_and_is_counted(workshop):
    workshop.run()
    workshop.run("total.times=3")

    garbage = find_garbage(workshop.root)

    assert kinds(garbage) == [
        "stage of climb",
        "stage of total",
        "unit of climb",
        "unit of total",
        "unit of total",
    ]
    assert all(each.bytes > 0 for each in garbage)


def test_finding_removes_nothing_and_sweeping_removes_just_that(workshop):
    workshop.run()
    workshop.run("total.times=3")
    garbage = find_garbage(workshop.root)
    assert all(each.path.is_dir() for each in garbage)

    assert remove_garbage(workshop.root) == garbage

    assert not any(each.path.exists() for each in garbage)
    assert {r.state for r in workshop.run("total.times=3").values()} == {"cached"}


def test_each_profile_keeps_its_latest(workshop):
    workshop.run()
    workshop.request(profile="short").remember(
        workshop.request(profile="short").plan((), {})
    )
    workshop.run("total.times=3")

    assert find_garbage(workshop.root) != []
    workshop.request(profile="short").remember(workshop.plan())
    assert find_garbage(workshop.root) == []


def test_units_of_an_unfinished_stage_are_kept(workshop):
    workshop.text("a.txt", "fail")
    workshop.run(run_options=RunOptions(keep_going=True))

    assert find_garbage(workshop.root) == []


def test_partial_folders_are_garbage_after_a_day(workshop):
    workshop.run()
    partial = workshop.root.units("count") / "0123456789abcdef.partial"
    partial.mkdir()
    assert find_garbage(workshop.root) == []
    old = partial.stat().st_mtime - PARTIAL_AGE_S - 60
    os.utime(partial, (old, old))

    assert kinds(find_garbage(workshop.root)) == ["left by a killed run"]


def test_nothing_is_swept_while_a_run_goes_on(workshop):
    workshop.run()
    workshop.run("total.times=3")

    with locked(workshop.root.lock("climb")), pytest.raises(LockedError):
        remove_garbage(workshop.root)

    assert len(find_garbage(workshop.root)) == 5


def test_an_empty_root_has_no_garbage(workshop):
    assert find_garbage(workshop.root) == []


def test_trash_is_garbage_at_once(workshop, monkeypatch):
    workshop.run()
    unit = next(workshop.root.units("count").iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda path, **how: None)
        remove_folder(unit)

    assert kinds(remove_garbage(workshop.root)) == ["left by a killed run"]

    assert list(workshop.root.units("count").glob("trash.*")) == []


TRAINING = """\
version: 1
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  train: {module: toy_train, deps: [count], params: [train]}
"""


@pytest.fixture
def trainer(workshop):
    """The workshop, where weights are trained, and others go on from them."""
    workshop.file.write_text(TRAINING)
    yield workshop
    sys.modules.pop("toy_train", None)


def test_weights_that_a_request_starts_from_are_kept(trainer):
    first = trainer.run()["train"].key
    start = f"train.initial_weights={first[:16]}"
    trainer.run(start)

    assert remove_garbage(trainer.root, named_weights(trainer.root)) == []

    assert trainer.run(start)["train"].state == "cached"


def test_weights_that_only_a_profile_starts_from_are_kept(trainer):
    first = trainer.run()["train"].key[:16]
    profile = f"profiles:\n  tuned: {{train: {{initial_weights: '{first}', steps: 2}}}}\n"
    trainer.file.write_text(TRAINING + profile)
    request = trainer.request(profile="tuned")
    trainer.request("train.seed=3").remember(request.plan((), {}))
    request.remember(request.plan((), {}))
    trainer.run("train.seed=3")

    assert remove_garbage(trainer.root, named_weights(trainer.root)) == []

    assert request.plan((), {})["train"].sources


def test_weights_are_kept_by_their_folder_and_for_a_stage_not_made_yet(trainer):
    first = trainer.run()["train"].key[:16]
    folder = trainer.root.stage("train") / first
    trainer.run("train.seed=3")
    plan = trainer.plan("train.seed=3")
    trainer.request(f"build-vocab.initial_weights={folder}").remember(plan)

    assert remove_garbage(trainer.root, named_weights(trainer.root)) == []


def test_weights_that_nothing_starts_from_any_more_are_garbage(trainer):
    first = trainer.run()["train"].key[:16]
    trainer.run(f"train.initial_weights={first}")
    trainer.run("train.seed=3")

    found = {
        each.path.name for each in remove_garbage(trainer.root, named_weights(trainer.root))
    }

    assert first in found
