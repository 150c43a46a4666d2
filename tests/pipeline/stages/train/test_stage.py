"""Training learns, stops, goes on, and ends with the same bytes however it got there."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from infgen.errors import ConfigError
from pipeline.engine import signals
from pipeline.engine.atomic import MANIFEST, StoreError
from pipeline.engine.layout import RUN_FOLDER
from pipeline.engine.manifest import list_files
from pipeline.engine.signals import Stopped
from pipeline.engine.stage import FinishedUnit, Source
from pipeline.engine.units import Task, do
from pipeline.stages.train.stage import (
    DONE,
    OUTPUTS,
    STAGE,
    finish,
    load_network,
    plan,
    reads,
    work,
)
from pipeline.stages.train.train_log import read_log
from pipeline.storage.checkpoint import POINTER
from pipeline.storage.weights import read_description

TERMS = (
    *("motion", "keep", "add", "position", "agent_type"),
    *("size", "heading", "offset", "map"),
)


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}


@pytest.fixture(scope="module")
def make(train_unit, train_settings, quiet):
    """``make(folder, progress, **changes)`` does the whole unit and returns its report."""

    def work_in(folder, progress=quiet, **changes):
        how = replace(train_settings["train"], **changes)
        return work(train_unit, folder, {**train_settings, "train": how}, progress)

    return work_in


@pytest.fixture(scope="module")
def whole(make, tmp_path_factory):
    """What an uninterrupted run leaves."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, make(folder)


def test_a_run_leaves_weights_their_page_and_their_log(whole):
    folder, report = whole

    assert sorted(p.name for p in folder.iterdir()) == sorted([*OUTPUTS, RUN_FOLDER])
    assert report["steps"] == 6
    assert report["scenes"] == report["validation_split"] == 3
    assert report["weights"] == read_description(folder)["weights"]
    assert report["validation"]["total"] > 0
    assert report["run"]["processes"] == 1
    assert report["device"] == "cpu"
    assert report["run"]["device"].startswith("CPU, ")
    assert report["run"]["scenes_per_s"] > 0


def test_the_log_has_every_term_of_every_step(whole):
    lines = read_log(whole[0] / "train.jsonl")

    assert [line["step"] for line in lines] == [1, 2, 3, 4, 4, 5, 6, 6]
    steps = [line for line in lines if "motion" in line]
    for name in TERMS:
        assert all(f"{name}_count" in line for line in steps)
    assert all(line["motion_perplexity"] > 1 for line in steps)
    assert [line["step"] for line in lines if "validation" in line] == [4, 6]
    assert steps[0]["learning_rate"] == pytest.approx(5e-4)


def test_speed_is_noted_apart_from_what_is_reproducible(whole):
    notes = read_log(whole[0] / RUN_FOLDER / "pace.jsonl")

    assert [note["step"] for note in notes] == [1, 2, 3, 4, 5, 6]
    assert all(note["scenes_per_s"] > 0 for note in notes)
    assert notes[-1]["peak_memory_mib"] > 10
    assert RUN_FOLDER not in {Path(name).parts[0] for name in list_files(whole[0])}


def test_the_same_run_gives_the_same_bytes(whole, make, tmp_path):
    make(tmp_path / "again")

    assert contents(tmp_path / "again") == contents(whole[0])


def test_how_often_checkpoints_are_written_and_by_whom_batches_are_made_is_free(
    whole, make, tmp_path
):
    make(tmp_path, checkpoint_every_steps=0, checkpoint_minutes=0.0, loader_workers=1)

    assert contents(tmp_path) == contents(whole[0])


def test_another_seed_gives_other_weights(whole, make, tmp_path):
    assert make(tmp_path, seed=1)["weights"] != whole[1]["weights"]


@pytest.mark.parametrize("stop_at", [1, 3, 6])
def test_a_run_that_is_stopped_saves_and_goes_on_to_the_same_bytes(
    whole, make, tmp_path, monkeypatch, stop_at
):
    monkeypatch.setattr("pipeline.stages.train.throughput.TELL_EVERY_S", 0.0)

    def stop(done, total, note=""):
        if done == stop_at:
            raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped):
        make(tmp_path, stop)
    assert json.loads((tmp_path / POINTER).read_text())["step"] == stop_at

    make(tmp_path)

    assert contents(tmp_path) == contents(whole[0])


@pytest.fixture(scope="module")
def do_unit(train_unit, train_settings, quiet):
    """``do_unit(folder, **changes)`` makes that folder as the engine does."""

    def do_in(folder, **changes):
        how = replace(train_settings["train"], **changes)
        settings = {**train_settings, "train": how}
        return do(
            Task("pipeline.stages.train.stage", train_unit, folder, settings, {}), quiet
        )

    return do_in


LAST_MOMENTS = (
    "pipeline.stages.train.loop.validate",
    "pipeline.storage.weights.save_network",
    "pipeline.storage.checkpoint.remove_checkpoints",
    "pipeline.engine.units.write_manifest",
    "pipeline.engine.atomic.sync_tree",
)
"""What is called after the last step, in this order."""
RARELY = {"checkpoint_every_steps": 0, "checkpoint_minutes": 0.0}


def happen_after(patch, name, call, happen):
    """Let something happen right after a call of a function."""
    module, function = name.rsplit(".", 1)
    real, calls = getattr(sys.modules[module], function), []

    def call_real(*arguments, **named):
        found = real(*arguments, **named)
        calls.append(name)
        if len(calls) == call:
            happen()
        return found

    patch.setattr(name, call_real)


@pytest.mark.parametrize("moment", LAST_MOMENTS)
def test_a_stop_after_the_last_step_waits_until_the_unit_has_its_name(
    do_unit, tmp_path, monkeypatch, moment
):
    stop = partial(os.kill, os.getpid(), signal.SIGTERM)
    happen_after(monkeypatch, moment, 1, stop)

    with signals.handling_signals(), pytest.raises(Stopped):
        do_unit(tmp_path / "unit", **RARELY, steps=1, validate_every_steps=0)

    assert sorted(p.name for p in tmp_path.iterdir()) == ["unit"]
    assert (tmp_path / "unit" / MANIFEST).is_file()
    assert not list((tmp_path / "unit").glob("checkpoint*"))


class Killed(BaseException):
    """Nothing that it passes saves anything."""


def die():
    raise Killed


@pytest.fixture
def do_twice(do_unit, tmp_path, monkeypatch):
    """``do_twice(moment, call, **changes)``: is killed after that call, and goes on."""

    def do_again(moment, call, **changes):
        folder = tmp_path / "unit"
        with monkeypatch.context() as patch:
            happen_after(patch, moment, call, die)
            with pytest.raises(Killed):
                do_unit(folder, **RARELY, **changes)
        assert not folder.exists()
        outcome = do_unit(folder, **RARELY, **changes)
        notes = read_log(folder / RUN_FOLDER / "pace.jsonl")
        assert [note["step"] for note in notes] == [1, 2, 3, 4, 5, 6]
        return folder, outcome.report

    return do_again


@pytest.mark.parametrize("moment", LAST_MOMENTS)
def test_a_kill_after_the_last_step_costs_no_step_and_changes_no_byte(
    whole, do_twice, moment
):
    validation = moment.endswith("validate")

    folder, report = do_twice(moment, call=2 if validation else 1)

    for name in OUTPUTS:
        assert (folder / name).read_bytes() == (whole[0] / name).read_bytes()
    assert report == {name: value for name, value in whole[1].items() if name != "run"}


def test_a_kill_where_the_last_step_is_validated_twice_changes_no_byte(
    make, do_twice, tmp_path
):
    make(tmp_path / "whole", validate_every_steps=3)

    folder, _ = do_twice("pipeline.storage.weights.save_network", 1, validate_every_steps=3)

    log = (folder / "train.jsonl").read_bytes()
    assert log == (tmp_path / "whole" / "train.jsonl").read_bytes()


def test_half_written_files_of_a_killed_run_are_not_published(do_unit, tmp_path):
    left = tmp_path / "unit.partial" / "checkpoint.json.0a1b2c3d.partial"
    left.parent.mkdir()
    left.write_text("{")

    do_unit(tmp_path / "unit", steps=0)

    assert not list(tmp_path.rglob("*.partial"))


SCRIPT = """
import json, sys
from pathlib import Path
from pipeline.engine.stage import Unit
from pipeline.stages.train.stage import STAGE, work
from infgen.settings import build
settings = json.loads(sys.argv[3])
settings = {k: build(STAGE.settings[k], v, k) for k, v in settings.items()}
work(Unit("weights", {}, json.loads(sys.argv[1])), Path(sys.argv[2]), settings, print)
"""


@pytest.fixture
def start(train_unit, train_settings):
    """``start(folder)`` begins the same run, in steps of its own time, as a process."""

    def start_in(folder):
        plain = {name: asdict(value) for name, value in train_settings.items()}
        plain["train"]["checkpoint_every_steps"] = 1
        words = [json.dumps(dict(train_unit.task)), str(folder), json.dumps(plain)]
        # Sums of several threads have other bytes: as many as there are in this process.
        threads = str(torch.get_num_threads())
        return subprocess.Popen(
            [sys.executable, "-c", SCRIPT, *words],
            stdout=subprocess.DEVNULL,
            cwd=Path(__file__).parents[4],
            env={**os.environ, "OMP_NUM_THREADS": threads},
        )

    return start_in


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_ends_with_the_same_bytes(
    whole, start, tmp_path
):
    random = np.random.default_rng(0)
    seen = []
    for kill in range(3):
        run = start(tmp_path)
        deadline = time.monotonic() + 120
        while run.poll() is None and checkpoint_step(tmp_path) <= kill:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(float(random.uniform(0, 0.2)))
        seen.append(checkpoint_step(tmp_path))
        run.kill()
        run.wait()

    assert start(tmp_path).wait() == 0

    assert seen == sorted(seen)
    assert seen[0] > 0
    # Both the weights and every line of the loss curve.
    assert contents(tmp_path) == contents(whole[0])


def checkpoint_step(folder):
    with suppress(FileNotFoundError):
        return json.loads((folder / POINTER).read_text())["step"]
    return 6 if (folder / RUN_FOLDER / DONE).exists() else 0


def test_weights_are_all_that_loading_needs(whole, train_settings, metre_moves, bent_roads):
    network = load_network(whole[0])

    assert not network.training
    np.testing.assert_array_equal(network.motion_vocabulary().path, metre_moves.path)
    np.testing.assert_array_equal(network.map_vocabulary().curve_m, bent_roads.curve_m)
    assert network.settings == train_settings["model"]
    assert network.grid_settings == train_settings["tokenize"]


@pytest.mark.parametrize("name", ["model.safetensors", "model.json"])
def test_missing_or_damaged_weights_are_named(whole, tmp_path, name):
    for file in OUTPUTS:
        (tmp_path / file).write_bytes((whole[0] / file).read_bytes())
    (tmp_path / name).unlink()
    with pytest.raises(StoreError, match=name):
        load_network(tmp_path)

    for damage in (b"{", b"{}", b"[]"):
        (tmp_path / name).write_bytes(damage)
        with pytest.raises(StoreError, match=name):
            load_network(tmp_path)


def test_weights_of_other_sizes_are_refused(whole, tmp_path):
    for file in OUTPUTS:
        (tmp_path / file).write_bytes((whole[0] / file).read_bytes())
    about = read_description(tmp_path)
    about["model"]["width"] = 32
    (tmp_path / "model.json").write_text(json.dumps(about))

    with pytest.raises(StoreError, match=r"does not fit its settings .{,400}$"):
        load_network(tmp_path)


def test_finish_gathers_what_the_unit_made(whole, train_settings, quiet, tmp_path):
    folder, report = whole
    target = tmp_path / "stage"

    found = finish(
        MadeInputs(),
        [FinishedUnit("weights", "k", folder, report)],
        target,
        train_settings,
        quiet,
    )

    assert contents(target) == contents(folder)
    assert found == {name: value for name, value in report.items() if name != "run"}


class MadeInputs:
    """Token shards of three files, as the engine shows them."""

    names = ("training.tfrecord-0", "training.tfrecord-1", "validation.tfrecord-0")
    sources = ()

    def key(self, stage):
        return f"key-{stage}"

    def units(self, stage):
        assert stage == "tokenize"
        return [FinishedUnit(n, f"key-{n}", Path("/tokens") / n, {}) for n in self.names]

    def folder(self, stage):
        return Path("/") / stage

    def content(self, stage, *names):
        return "-".join((stage, *names))


def test_the_plan_is_one_unit_of_the_two_splits(train_settings):
    (unit,) = plan(MadeInputs(), train_settings)

    tokens = "/tokens/"
    training = [f"{tokens}training.tfrecord-0", f"{tokens}training.tfrecord-1"]
    assert unit.task["scenes"] == training
    assert unit.task["validation_split"] == [f"{tokens}validation.tfrecord-0"]
    assert unit.inputs["vocabularies"] == "build-vocab-motion.zarr-roads.zarr"
    assert unit.inputs["scenes/training.tfrecord-1"] == "key-training.tfrecord-1"
    assert STAGE.resumes
    assert STAGE.in_driver


class BegunInputs(MadeInputs):
    """The same, with weights to begin with."""

    sources = (Source("/weights", "initial_weights", "f" * 64),)


def test_weights_to_begin_with_are_part_of_the_unit(train_settings):
    (unit,) = plan(BegunInputs(), train_settings)

    assert unit.inputs["initial_weights"] == "f" * 64
    assert unit.task["initial_weights"] == "/weights"


@pytest.fixture
def asking(train_settings):
    def ask(start):
        return {
            **train_settings,
            "train": replace(train_settings["train"], initial_weights=start),
        }

    return ask


def test_weights_to_begin_with_are_named_by_folder_or_key(whole, asking, tmp_path):
    key = "0123456789abcdef"
    made = tmp_path / "store" / "train" / key
    shutil.copytree(whole[0], made)
    latest = tmp_path / "latest"
    latest.symlink_to(made)

    for word in (str(made), str(latest), key, key + 48 * "0", key[:5]):
        assert reads(tmp_path, asking(word)) == [
            Source(str(made), "initial_weights", whole[1]["weights"])
        ]
    assert reads(tmp_path, asking("")) == []
    with pytest.raises(
        ConfigError, match=r"train.initial_weights is 'beef', but there is no such"
    ):
        reads(tmp_path, asking("beef"))


def test_training_goes_on_from_the_weights_it_begins_with(
    whole, train_unit, train_settings, quiet, tmp_path
):
    task = {**train_unit.task, "initial_weights": str(whole[0])}
    how = replace(train_settings["train"], steps=0, seed=9)

    report = work(
        replace(train_unit, task=task), tmp_path, {**train_settings, "train": how}, quiet
    )

    assert report["weights"] == whole[1]["weights"]


def test_a_share_of_the_weights_it_begins_with_is_kept(
    whole, train_unit, train_settings, quiet, tmp_path
):
    unit = replace(train_unit, task={**train_unit.task, "initial_weights": str(whole[0])})
    made = {}
    for share in (0.0, 0.5, 1.0):
        how = replace(train_settings["train"], steps=2, seed=9, initial_share=share)
        folder = tmp_path / str(share)
        work(unit, folder, {**train_settings, "train": how}, quiet)
        made[share] = load_network(folder).state_dict()

    begun = load_network(whole[0]).state_dict()
    assert any(not torch.equal(begun[name], made[0.0][name]) for name in begun)
    for name, before in begun.items():
        torch.testing.assert_close(made[1.0][name], before, rtol=0, atol=1e-7)
        if before.is_floating_point():
            middle = (before + made[0.0][name]) / 2
            torch.testing.assert_close(made[0.5][name], middle)
