"""Training learns, stops, goes on, and ends with the same bytes however it got there."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.tokens.codebook import MotionCodebook, RoadCodebook
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.checkpoint import POINTER, load_checkpoint, save_checkpoint
from pipeline.folders import StoreError
from pipeline.loader import TokenScenes, held_out_batches, train_batches
from pipeline.stage import Done, Unit
from pipeline.stopping import Stopped
from pipeline.store import write_records
from pipeline.tokenize import SCHEMA
from pipeline.train import OUTPUTS, STAGE, finish, load_network, plan, work
from pipeline.train_log import read_log
from pipeline.training import Course, TrainingError, begin, train
from pipeline.weights import read_about, state_of

SETTINGS = {
    "tokenize": TokenSettings(grid_radius_m=60.0, grid_step_m=4.0),
    "model": ModelSettings(
        width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
    ),
    "train": TrainSettings(
        steps=6,
        batch_scenes=2,
        warmup_steps=2,
        checkpoint_every=2,
        validate_every=4,
        validation_scenes=2,
        learning_rate=1e-3,
    ),
}


TERMS = ("motion", "stay", "add", "cell", "kind", "size", "heading", "offset", "map")


def quiet(done, total, note=""):
    """Nobody listens."""


@pytest.fixture(scope="module")
def shards(tmp_path_factory, crossing, metre_moves, bent_roads):
    """Two token shards of three scenes each, and the codebooks they are written with."""
    folder = tmp_path_factory.mktemp("shards")
    for number, name in enumerate(("training", "validation")):
        scenes = [crossing(speed_mps=8.0 + 2 * number + i) for i in range(3)]
        tokens = [
            replace(
                tokenize_scene(scene, metre_moves, bent_roads, SETTINGS["tokenize"]),
                scenario_id=f"{name}-{i}",
            )
            for i, scene in enumerate(scenes)
        ]
        group = folder / name / "tokens-000.zarr"
        group.parent.mkdir()
        write_records(group, tokens, SceneTokens, SCHEMA, compress=False)
    books = folder / "vocab"
    books.mkdir()
    for name, book, kind, schema in (
        ("motion", metre_moves, MotionCodebook, "infgen.motion/1"),
        ("roads", bent_roads, RoadCodebook, "infgen.roads/1"),
    ):
        write_records(books / f"{name}.zarr", [book], kind, schema, compress=False)
    return folder


@pytest.fixture(scope="module")
def unit(shards):
    task = {
        "scenes": [str(shards / "training")],
        "held_out": [str(shards / "validation")],
        "codebooks": str(shards / "vocab"),
    }
    return Unit("weights", {}, task)


@pytest.fixture
def course(shards, tmp_path):
    return Course(
        SETTINGS["model"],
        SETTINGS["train"],
        SETTINGS["tokenize"],
        TokenScenes([shards / "training"]),
        TokenScenes([shards / "validation"]),
        tmp_path,
    )


@pytest.fixture
def books(metre_moves, bent_roads):
    return metre_moves, bent_roads


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}


@pytest.fixture(scope="module")
def whole(unit, tmp_path_factory):
    """What an uninterrupted run leaves."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, work(unit, folder, SETTINGS, quiet)


def test_a_run_leaves_weights_their_page_and_their_log(whole):
    folder, report = whole

    assert sorted(p.name for p in folder.iterdir()) == sorted(OUTPUTS)
    assert report["steps"] == 6
    assert report["scenes"] == report["held_out"] == 3
    assert report["weights"] == read_about(folder)["weights"]
    assert report["validation"]["total"] > 0
    assert set(report["run"]) == {"seconds", "threads"}


def test_the_log_has_every_term_of_every_step(whole):
    lines = read_log(whole[0] / "train.jsonl")

    assert [line["step"] for line in lines] == [1, 2, 3, 4, 4, 5, 6, 6]
    steps = [line for line in lines if "motion" in line]
    for name in TERMS:
        assert all(f"{name}_count" in line for line in steps)
    assert [line["step"] for line in lines if "validation" in line] == [4, 6]
    assert steps[0]["learning_rate"] == pytest.approx(5e-4)


def test_the_same_run_gives_the_same_bytes(whole, unit, tmp_path):
    work(unit, tmp_path / "again", SETTINGS, quiet)

    assert contents(tmp_path / "again") == contents(whole[0])


def test_another_seed_gives_other_weights(whole, unit, tmp_path):
    other = {**SETTINGS, "train": replace(SETTINGS["train"], seed=1)}

    report = work(unit, tmp_path, other, quiet)

    assert report["weights"] != whole[1]["weights"]


@pytest.mark.parametrize("stop_at", [1, 3, 6])
def test_a_run_that_is_stopped_saves_and_goes_on_to_the_same_bytes(
    whole, unit, tmp_path, monkeypatch, stop_at
):
    monkeypatch.setattr("pipeline.training.TELL_EVERY_S", 0.0)

    def stop(done, total, note=""):
        if done == stop_at:
            raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped):
        work(unit, tmp_path, SETTINGS, stop)
    assert json.loads((tmp_path / POINTER).read_text())["step"] == stop_at

    work(unit, tmp_path, SETTINGS, quiet)

    assert contents(tmp_path) == contents(whole[0])


SCRIPT = """
import json, sys
from pathlib import Path
from pipeline.stage import Unit
from pipeline.train import STAGE, work
from infgen.config import build
settings = json.loads(sys.argv[3])
settings = {k: build(STAGE.settings[k], v, k) for k, v in settings.items()}
work(Unit("weights", {}, json.loads(sys.argv[1])), Path(sys.argv[2]), settings, print)
"""


def start(unit, folder):
    settings = {name: asdict(value) for name, value in SETTINGS.items()}
    words = [json.dumps(dict(unit.task)), str(folder), json.dumps(settings)]
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *words],
        stdout=subprocess.DEVNULL,
        cwd=Path(__file__).parents[2],
    )


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_ends_with_the_same_bytes(
    whole, unit, tmp_path
):
    random = np.random.default_rng(0)
    for _ in range(3):
        run = start(unit, tmp_path)
        deadline = time.monotonic() + 60
        while run.poll() is None and not list(tmp_path.glob("checkpoint-*")):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(float(random.uniform(0, 0.5)))
        run.kill()
        run.wait()

    assert start(unit, tmp_path).wait() == 0

    assert contents(tmp_path) == contents(whole[0])


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(course, books):
    training = begin(course, *books)
    save_checkpoint(course.folder, training, 2)
    half = course.folder / "checkpoint-000000004"
    half.mkdir()
    (half / "network.safetensors").write_bytes(b"half")
    before = {name: value.clone() for name, value in state_of(training.network).items()}
    for parameter in training.network.parameters():
        parameter.data += 1

    assert load_checkpoint(course.folder, training) == 2

    after = state_of(training.network)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    save_checkpoint(course.folder, training, 4)
    assert [p.name for p in course.folder.glob("checkpoint-*")] == [half.name]


def test_a_checkpoint_holds_the_optimiser_and_the_average(course, books):
    training = begin(course, *books)
    train(replace(course, train=replace(course.train, steps=2)), training, quiet)
    other = begin(course, *books)

    assert load_checkpoint(course.folder, other) == 2

    for name, value in training.average.items():
        assert torch.equal(other.average[name], value)
    pairs = zip(training.network.parameters(), other.network.parameters(), strict=True)
    for one, two in pairs:
        state, restored = training.optimiser.state[one], other.optimiser.state[two]
        assert state.keys() == restored.keys()
        assert all(torch.equal(state[what], restored[what]) for what in state)


def test_a_loss_that_is_not_finite_names_its_scenes_and_keeps_the_weights(
    course, books, monkeypatch
):
    training = begin(course, *books)
    batches = train_batches

    def broken(*arguments):
        for number, batch in enumerate(batches(*arguments)):
            size = batch.agents.size_lwh_m * (torch.nan if number == 3 else 1)
            yield replace(batch, agents=replace(batch.agents, size_lwh_m=size))

    monkeypatch.setattr("pipeline.training.train_batches", broken)

    with pytest.raises(TrainingError, match=r"step 3: .* training-\d, training-\d"):
        train(course, training, quiet)

    other = begin(course, *books)
    assert load_checkpoint(course.folder, other) == 3
    assert all(torch.isfinite(p).all() for p in other.network.parameters())


def test_no_scenes_to_train_on_is_said(course, books):
    empty = replace(course, scenes=TokenScenes([]))

    with pytest.raises(TrainingError, match="no scenes of split 'training'"):
        train(empty, begin(course, *books), quiet)


def test_without_held_out_scenes_there_is_no_validation(course, books):
    found = train(replace(course, held_out=[]), begin(course, *books), quiet)

    assert found == {}


def test_the_loss_goes_down(course, books):
    how = replace(course.train, steps=30, learning_rate=1e-2, label_smoothing=0.0)
    longer = replace(course, train=replace(how, checkpoint_every=1000, validate_every=0))

    train(longer, begin(longer, *books), quiet)

    motion = [line["motion"] for line in read_log(course.folder / "train.jsonl")[:-1]]
    assert len(motion) == 30
    assert np.mean(motion[-5:]) < 0.7 * np.mean(motion[:5])


def test_weights_are_all_that_loading_needs(whole, metre_moves, bent_roads):
    network = load_network(whole[0])

    assert not network.training
    np.testing.assert_array_equal(network.motion_codebook().path, metre_moves.path)
    np.testing.assert_array_equal(network.road_codebook().curve_m, bent_roads.curve_m)
    assert network.settings == SETTINGS["model"]
    assert network.grid_settings == SETTINGS["tokenize"]


@pytest.mark.parametrize("name", ["model.safetensors", "model.json"])
def test_missing_or_damaged_weights_are_named(whole, tmp_path, name):
    for file in OUTPUTS:
        (tmp_path / file).write_bytes((whole[0] / file).read_bytes())
    (tmp_path / name).unlink()
    with pytest.raises(StoreError, match=name):
        load_network(tmp_path)

    (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(StoreError, match=name):
        load_network(tmp_path)


def test_weights_of_other_sizes_are_refused(whole, tmp_path):
    for file in OUTPUTS:
        (tmp_path / file).write_bytes((whole[0] / file).read_bytes())
    about = read_about(tmp_path)
    about["model"]["width"] = 32
    (tmp_path / "model.json").write_text(json.dumps(about))

    with pytest.raises(StoreError, match="does not fit its settings"):
        load_network(tmp_path)


def test_finish_gathers_what_the_unit_made(whole, tmp_path):
    folder, report = whole
    target = tmp_path / "stage"

    found = finish(
        MadeInputs(), [Done("weights", "k", folder, report)], target, SETTINGS, quiet
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
        return [Done(n, f"key-{n}", Path("/tokens") / n, {}) for n in self.names]

    def folder(self, stage):
        return Path("/") / stage

    def content(self, stage, *names):
        return "-".join((stage, *names))


def test_the_plan_is_one_unit_of_the_two_splits():
    (unit,) = plan(MadeInputs(), SETTINGS)

    tokens = "/tokens/"
    training = [f"{tokens}training.tfrecord-0", f"{tokens}training.tfrecord-1"]
    assert unit.task["scenes"] == training
    assert unit.task["held_out"] == [f"{tokens}validation.tfrecord-0"]
    assert unit.inputs["codebooks"] == "build-vocab-motion.zarr-roads.zarr"
    assert unit.inputs["scenes/training.tfrecord-1"] == "key-training.tfrecord-1"
    assert STAGE.resumes
    assert STAGE.in_driver


def test_the_batch_of_a_step_does_not_depend_on_where_training_began(course):
    from_start = list(train_batches(course.scenes, course.limits, 2, 0, range(5)))
    from_three = list(train_batches(course.scenes, course.limits, 2, 0, range(3, 5)))

    for one, two in zip(from_start[3:], from_three, strict=True):
        assert one.scenario_ids == two.scenario_ids
        assert torch.equal(one.agents.pose, two.agents.pose)
        assert torch.equal(one.roads.picked, two.roads.picked)


def test_held_out_batches_are_the_same_each_time_and_no_more_than_asked_for(course):
    first, again = (
        [b.scenario_ids for b in held_out_batches(course.held_out, course.limits, 2, 0, 3)]
        for _ in range(2)
    )

    assert first == again
    assert [len(ids) for ids in first] == [2, 1]


def test_scenes_of_several_groups_are_one_sequence(shards):
    scenes = TokenScenes([shards / "training", shards / "validation"])

    assert len(scenes) == 6
    assert scenes[3].scenario_id == "validation-0"
    assert [scene.scenario_id for scene in scenes[4:]] == ["validation-1", "validation-2"]
    with pytest.raises(IndexError):
        scenes[6]
