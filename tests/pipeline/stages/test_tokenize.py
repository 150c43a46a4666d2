import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from infgen.config import TokenSettings
from infgen.scene import Scene
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.engine.stage import FinishedUnit, Unit
from pipeline.stages import tokenize as stage
from pipeline.stages import vocabulary
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import open_group, write_records

SETTINGS = TokenSettings()


@dataclass
class Finished:
    """Inputs of the stage: what earlier stages left on disk."""

    scenes: list[FinishedUnit]
    vocabularies: Path
    sources: tuple = ()
    asked: list = field(default_factory=list)

    def units(self, name):
        return {"ingest": self.scenes}[name]

    def folder(self, name):
        return {"build-vocab": self.vocabularies}[name]

    def content(self, name, *names):
        self.asked.append((name, names))
        return "vocabularies-as-they-are"

    def key(self, name):
        raise AssertionError("a key changes more often than what the stage reads")


def no_progress(done, total, note=""):
    pass


@pytest.fixture
def vocabularies(tmp_path, metre_moves, bent_roads):
    folder = tmp_path / "vocab"
    folder.mkdir()
    for name, book, schema in (
        ("motion.zarr", metre_moves, vocabulary.MOTION_SCHEMA),
        ("roads.zarr", bent_roads, vocabulary.ROADS_SCHEMA),
    ):
        kind = {"motion.zarr": MotionVocabulary, "roads.zarr": MapVocabulary}[name]
        write_records(folder / name, [book], kind, schema, compress=False)
    return folder


@pytest.fixture
def scenes(drive, crossing, parked):
    named = {"a": drive(), "b": crossing(), "bad": drive(now=3), "c": parked()}
    return [dataclasses.replace(scene, scenario_id=name) for name, scene in named.items()]


@pytest.fixture
def ingested(tmp_path, scenes):
    """Two ingested files: three scenes of training, one of validation."""
    done = []
    for name, part in (
        ("training.tfrecord-0", scenes[:3]),
        ("validation.tfrecord-0", scenes[3:]),
    ):
        folder = tmp_path / name
        folder.mkdir()
        write_records(folder / "scenes-000.zarr", part, Scene, SCENES_SCHEMA, compress=True)
        done.append(FinishedUnit(name, f"key of {name}", folder, {"scenes": len(part)}))
    return done


@pytest.fixture
def tokenized(tmp_path, ingested, vocabularies):
    """Both units, done."""
    inputs = Finished(ingested, vocabularies)
    return [
        _do(unit, tmp_path / "tokens" / unit.name) for unit in stage.plan(inputs, SETTINGS)
    ]


def _do(unit: Unit, target: Path) -> FinishedUnit:
    target.mkdir(parents=True)
    report = stage.work(unit, target, SETTINGS, no_progress)
    return FinishedUnit(unit.name, "key", target, report)


def test_there_is_one_unit_per_file_and_it_hangs_on_scenes_and_codebooks(
    ingested, vocabularies
):
    inputs = Finished(ingested, vocabularies)

    units = stage.plan(inputs, SETTINGS)

    assert [unit.name for unit in units] == ["training.tfrecord-0", "validation.tfrecord-0"]
    assert units[0].inputs == {
        "scenes": "key of training.tfrecord-0",
        "vocabularies": "vocabularies-as-they-are",
    }
    assert inputs.asked == [("build-vocab", ("motion.zarr", "roads.zarr"))]
    json.dumps(units[0].task)


def test_tokens_on_disk_are_those_of_the_tokenizer(
    tokenized, scenes, metre_moves, bent_roads
):
    (group,) = stage.open_tokens(tokenized[0].path)

    assert len(group) == 2
    for tokens, scene in zip(group, scenes, strict=False):
        expected = tokenize_scene(scene, metre_moves, bent_roads, SETTINGS)
        for column in dataclasses.fields(SceneTokens):
            one, two = getattr(tokens, column.name), getattr(expected, column.name)
            np.testing.assert_array_equal(one, two, err_msg=column.name)


def test_tokens_can_be_read_in_parts(tokenized):
    columns, about = open_group(tokenized[0].path / "tokens-000.zarr")

    assert len(columns["bytes"][3:6]) == 3
    assert about["schema"] == "infgen.tokens/3"
    assert about["count"] == 2
    assert len(columns["sizes"][:]) == 2 * len(about["dims"])


def test_a_scene_that_cannot_be_tokenized_is_named_with_the_reason(tokenized):
    refused = pl.read_parquet(tokenized[0].path / "refused.parquet")

    (row,) = refused.to_dicts()
    assert row["scenario_id"] == "bad"
    assert row["unit"] == "training.tfrecord-0"
    assert "which no token ends at" in row["reason"]
    assert tokenized[0].report["refused"] == 1
    assert tokenized[0].report["scenes"] == 2


def test_the_index_says_where_each_scene_is_and_how_large(tokenized):
    index = pl.read_parquet(tokenized[0].path / "index.parquet").to_dicts()

    (group,) = stage.open_tokens(tokenized[0].path)
    assert [row["scenario_id"] for row in index] == ["a", "b"]
    for row in index:
        tokens = group[row["row"]]
        assert row["split"] == "training"
        assert row["group"] == "tokens-000.zarr"
        assert row["agents"] == tokens.num_agents
        assert row["tokens"] == tokens.num_tokens
        assert row["roads"] == tokens.num_map_tokens
        assert row["words"] == len(tokens.sequence_type)
        assert row["entries"] == len(tokens.insertion_agent)


def test_many_scenes_make_several_groups(tmp_path, ingested, vocabularies, monkeypatch):
    monkeypatch.setattr(stage, "SCENES_PER_GROUP", 1)
    (unit, _) = stage.plan(Finished(ingested, vocabularies), SETTINGS)

    done = _do(unit, tmp_path / "small")

    groups = stage.open_tokens(done.path)
    index = pl.read_parquet(done.path / "index.parquet")
    assert [len(group) for group in groups] == [1, 1]
    assert index["group"].to_list() == ["tokens-000.zarr", "tokens-001.zarr"]
    assert index["row"].to_list() == [0, 0]


def test_doing_a_unit_again_writes_the_same_bytes(
    tmp_path, ingested, vocabularies, tokenized
):
    (unit, _) = stage.plan(Finished(ingested, vocabularies), SETTINGS)

    again = _do(unit, tmp_path / "again")

    def files(folder):
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    assert files(again.path) == files(tokenized[0].path)
    assert again.report == tokenized[0].report


def test_an_empty_file_gives_an_empty_unit(tmp_path, vocabularies):
    (tmp_path / "none").mkdir()
    empty = FinishedUnit("none.tfrecord", "key", tmp_path / "none", {"scenes": 0})
    (unit,) = stage.plan(Finished([empty], vocabularies), SETTINGS)

    done = _do(unit, tmp_path / "out")

    assert stage.open_tokens(done.path) == []
    assert done.report["scenes"] == 0
    assert len(pl.read_parquet(done.path / "index.parquet")) == 0


def test_the_stage_joins_the_tables_and_adds_up_split_by_split(
    tmp_path, ingested, vocabularies, tokenized
):
    target = tmp_path / "stage"
    target.mkdir()

    report = stage.finish(
        Finished(ingested, vocabularies), tokenized, target, SETTINGS, no_progress
    )

    assert report["scenes"] == 3
    assert report["refused"] == 1
    index = pl.read_parquet(target / "index.parquet")
    assert index["scenario_id"].to_list() == ["a", "b", "c"]
    assert index["split"].to_list() == ["training", "training", "validation"]
    assert pl.read_parquet(target / "refused.parquet")["scenario_id"].to_list() == ["bad"]
    figures = json.loads((target / "report.json").read_text())
    assert sorted(figures) == ["training", "validation"]
    assert figures["training"]["agents"] == {"vehicle": 3, "pedestrian": 1, "cyclist": 1}
    assert figures["validation"]["share_entering_after_now"] == 0.0


def test_a_stage_without_files_finishes(tmp_path, vocabularies):
    target = tmp_path / "stage"
    target.mkdir()

    report = stage.finish(Finished([], vocabularies), [], target, SETTINGS, no_progress)

    assert report == {"scenes": 0, "refused": 0, "words": 0}
