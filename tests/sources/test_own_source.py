"""A source that is written as ``docs/own-source.md`` says is ingested as any other."""

import importlib
import json
from pathlib import Path

import polars as pl
import pytest

from infgen.config import IngestSettings
from infgen.sources.registry import SOURCES, find_below
from infgen.sources.scene_files import SceneSource
from pipeline.engine.layout import Root
from pipeline.stages.ingest import STAGE
from pipeline.storage.scenes import read_scenes
from pipeline.storage.sources.source_files import find_sources
from tests.pipeline.stages.test_ingest import Files, no_progress

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def own(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    source = importlib.import_module("own_source")
    monkeypatch.setitem(SOURCES, "ownlogs", source)
    return source


@pytest.fixture
def folder(tmp_path):
    agent = {"size_lwh_m": [4.8, 2.0, 1.6], "heading_rad": [0.0] * 30}
    agents = [
        {"name": name, "xy_m": [[x_m + 0.8 * step, 0.0] for step in range(30)], **agent}
        for name, x_m in (("me", 0.0), ("7", 20.0))
    ]
    log = {"format": "own-logs", "id": "a", "split": "training", "ego": "me"}
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/a.json").write_text(json.dumps(log | {"agents": agents}))
    (tmp_path / "logs/b.json").write_text('{"format": "own-logs", "id": ')
    (tmp_path / "logs/other.json").write_text("{}")
    return tmp_path / "logs"


def test_a_module_of_three_functions_is_a_source(own):
    assert isinstance(own, SceneSource)


def test_its_scenes_are_found_by_content_and_read(own, folder):
    found = list(find_below(str(folder)))

    assert [each.files.name for each in found] == ["logs/a.json", "logs/b.json"]
    assert found[0].label == ("training", "a")
    scene = found[0].read().scene
    assert scene.tracks.id.tolist() == [0, 7]
    assert scene.tracks.velocity_mps[1, 5].tolist() == pytest.approx([8.0, 0.0])


def test_they_are_ingested_in_groups_and_bad_ones_are_named(own, folder, tmp_path):
    (source,) = find_sources([str(folder)], Root(tmp_path / "root"))
    (unit,) = STAGE.plan(Files(source), IngestSettings())
    STAGE.work(unit, tmp_path / "unit", IngestSettings(), no_progress)

    assert source.name == "training.ownlogs-00000-of-00001"
    assert [scene.scenario_id for scene in read_scenes(tmp_path / "unit")] == ["a"]
    quarantine = pl.read_parquet(tmp_path / "unit/quarantine.parquet")
    assert quarantine["reason"].item().startswith("logs/b.json: not JSON")
