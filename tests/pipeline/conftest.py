"""Toy stages that do small, real work on real files, and a training run of seconds."""

import os
import sys
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import pytest
import torch

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.network import Network
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.runner import RunOptions, StageResult, run
from pipeline.engine.stage import Unit
from pipeline.settings.request import Request
from pipeline.stages.tokenize import SCHEMA
from pipeline.stages.train.loader import TokenScenes
from pipeline.stages.train.setup import TrainingSetup
from pipeline.storage.weights import save_network, state_dict_of
from pipeline.storage.whole_records import write_whole_records
from pipeline.storage.zarr_store import write_records
from tests.pipeline.finished import TINY

TOYS = Path(__file__).with_name("toys")
STAGES = """\
version: 1
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  total: {module: toy_total, deps: [count], params: [total]}
  climb: {module: toy_climb, deps: [total], params: [climb]}
params:
  total: {times: 2}
profiles:
  short: {count: {longest: 3}}
"""


@pytest.fixture(scope="session")
def source():
    """The smallest file of built-in records."""
    return min(builtin_records(), key=lambda path: path.stat().st_size)


@pytest.fixture(scope="session")
def scenes(source):
    """Its first three scenes."""
    return list(islice(iter_scenes(source), 3))


@dataclass
class Workshop:
    """A root, a ``stages.yaml`` with three toy stages, and some texts to count."""

    folder: Path

    @property
    def root(self) -> Root:
        return Root(self.folder / "root")

    @property
    def file(self) -> Path:
        return self.folder / "stages.yaml"

    @property
    def texts(self) -> Path:
        return self.folder / "texts"

    def text(self, name: str, words: str) -> Path:
        path = self.texts / name
        path.write_text(words)
        return path

    def request(self, *overrides: str, profile: str | None = None) -> Request:
        records = (str(self.texts / "*.txt"),)
        return Request(self.root, self.file, profile, records, overrides)

    def plan(self, *overrides: str, targets: tuple[str, ...] = ()):
        return self.request(*overrides).plan(targets, {})

    def run(
        self,
        *overrides: str,
        targets: tuple[str, ...] = (),
        run_options: RunOptions | None = None,
        events: list | None = None,
    ) -> dict[str, StageResult]:
        listeners = () if events is None else (events.append,)
        plan = self.plan(*overrides, targets=targets)
        self.request(*overrides).remember(plan)
        results = run(plan, run_options or RunOptions(), Events(self.root, listeners))
        return {result.stage: result for result in results}

    def files(self) -> dict[str, bytes]:
        """Everything made, without what differs between runs."""
        return {
            str(path.relative_to(self.root.path)): path.read_bytes()
            for path in sorted(self.root.store.rglob("*"))
            if path.is_file()
            and path.name not in ("run.json", "lock", "begun-at", "attempt.json")
        }


@pytest.fixture
def workshop(tmp_path, monkeypatch) -> Workshop:
    monkeypatch.syspath_prepend(str(TOYS))
    # What syncing is for is not seen by a test, and it is most of a toy run's time.
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    shop = Workshop(tmp_path)
    shop.file.write_text(STAGES)
    shop.texts.mkdir()
    shop.text("a.txt", "one two three four")
    shop.text("b.txt", "lorem ipsum")
    yield shop
    for name in ("toy_count", "toy_total", "toy_climb"):
        sys.modules.pop(name, None)


TRAINING = {
    "tokenize": TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0),
    "model": ModelSettings(
        width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
    ),
    "train": TrainSettings(
        steps=6,
        batch_scenes=2,
        warmup_steps=2,
        checkpoint_every_steps=2,
        validate_every_steps=4,
        validation_scenes=2,
        learning_rate=1e-3,
    ),
}


@pytest.fixture(scope="session")
def train_settings():
    """Settings, by section, of a training run of seconds."""
    return TRAINING


@pytest.fixture(scope="session")
def shards(tmp_path_factory, crossing, metre_moves, bent_roads):
    """Two token shards of three scenes each, and the vocabularies they are written with."""
    folder = tmp_path_factory.mktemp("shards")
    for number, name in enumerate(("training", "validation")):
        scenes = [crossing(speed_mps=8.0 + 2 * number + i) for i in range(3)]
        tokens = [
            replace(
                tokenize_scene(scene, metre_moves, bent_roads, TRAINING["tokenize"]),
                scenario_id=f"{name}-{i}",
            )
            for i, scene in enumerate(scenes)
        ]
        group = folder / name / "tokens-000.zarr"
        group.parent.mkdir()
        write_whole_records(group, tokens, SceneTokens, SCHEMA)
    books = folder / "vocab"
    books.mkdir()
    for name, book, kind, schema in (
        ("motion", metre_moves, MotionVocabulary, "infgen.motion/1"),
        ("roads", bent_roads, MapVocabulary, "infgen.roads/1"),
    ):
        write_records(books / f"{name}.zarr", [book], kind, schema, compress=False)
    return folder


@pytest.fixture(scope="session")
def train_unit(shards):
    """The unit of work of stage ``train`` on these shards."""
    task = {
        "scenes": [str(shards / "training")],
        "sources": ["tfrecord"],
        "validation_split": [str(shards / "validation")],
        "vocabularies": str(shards / "vocab"),
    }
    return Unit("weights", {}, task)


@pytest.fixture
def setup(shards, tmp_path):
    """The same as what a training loop is given."""
    return TrainingSetup(
        TRAINING["model"],
        TRAINING["train"],
        TRAINING["tokenize"],
        TokenScenes([shards / "training"]),
        TokenScenes([shards / "validation"]),
        tmp_path,
    )


@pytest.fixture
def books(metre_moves, bent_roads):
    """The vocabularies of the shards."""
    return metre_moves, bent_roads


@pytest.fixture(scope="session")
def quiet():
    """A progress that nobody listens to."""

    def tell(done, total, note=""):
        assert 0 <= done <= total

    return tell


@pytest.fixture
def weights(tmp_path, metre_moves, bent_roads):
    """A stage folder with the weights of a tiny network that has learned nothing."""
    torch.manual_seed(0)
    network = Network(TINY, metre_moves, bent_roads, TokenSettings())
    folder = tmp_path / "train"
    folder.mkdir()
    save_network(folder, network, state_dict_of(network), step=7)
    return folder
