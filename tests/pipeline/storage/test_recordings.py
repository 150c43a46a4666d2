"""Recorded drives on disk, and the commands that read them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from cli import main
from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.settings import key_values
from pipeline.engine.plan import PlanError
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import rollout as stage
from pipeline.storage.recordings import (
    About,
    find_recordings,
    fingerprint,
    is_recording,
    read_about,
    write_recording,
)
from pipeline.storage.rollouts import read_rollouts
from tests.exports.replays import replay, with_newcomer

SOURCE = "validation.tfrecord-00000-of-00001"


def infgen(*words):
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return left.value.code or 0


def record(folder, scene, seed=0, source=SOURCE) -> Path:
    rollout = replace(with_newcomer(replay(scene, 0), 30), seed=seed)
    about = About(source, "motion, entries, exits", RolloutSettings(add_bias=0.25, count=1))
    write_recording(folder, rollout, scene, about)
    return folder


@pytest.fixture
def recordings(tmp_path, scenes) -> Path:
    """A folder with two drives through one scene, and one through another."""
    folder = tmp_path / "drives"
    record(folder / "a", scenes[0])
    record(folder / "b", scenes[1], seed=1)
    record(folder / "c", scenes[0], seed=2)
    (folder / "notes").mkdir()
    return folder


def test_a_recording_is_read_back(tmp_path, scenes):
    folder = record(tmp_path / "drive", scenes[0])

    (rollout,) = read_rollouts(folder)

    expected = with_newcomer(replay(scenes[0], 0), 30)
    np.testing.assert_array_equal(rollout.xyz_m, expected.xyz_m)
    assert is_recording(folder)
    assert not is_recording(tmp_path)
    about = read_about(folder)
    assert (about["drive"]["source"], about["drive"]["rules"]) == (SOURCE, "none")
    assert about["settings"]["rollout"]["add_bias"] == 0.25
    assert "scenes/index.parquet" in about["files"]


def test_nothing_is_written_over(tmp_path, scenes):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive/file").write_text("")

    with pytest.raises(ConfigError, match="name another folder"):
        record(tmp_path / "drive", scenes[0])
    assert not list(tmp_path.glob("*.partial"))


def test_recordings_are_found_by_name_and_alone(recordings):
    names = [path.name for path in find_recordings(recordings, "rollout.recordings")]

    assert names == ["a", "b", "c"]
    assert find_recordings(recordings / "b", "rollout.recordings") == [recordings / "b"]
    with pytest.raises(ConfigError, match=r"rollout\.recordings is .*notes.*no recorded"):
        find_recordings(recordings / "notes", "rollout.recordings")


def test_a_fingerprint_is_of_what_was_driven_and_not_of_when(recordings, tmp_path, scenes):
    again = record(tmp_path / "again", scenes[0])

    assert fingerprint(again) != fingerprint(recordings / "c")
    shutil.copytree(recordings / "c", tmp_path / "moved")
    assert fingerprint(tmp_path / "moved") == fingerprint(recordings / "c")


class Inputs:
    """What stage ``rollout`` reads."""

    def __init__(self, settings, *files):
        self.sources = stage.STAGE.reads(Path("root"), settings)
        self._files = files

    def units(self, name):
        assert name == "ingest"
        return [
            FinishedUnit(file, f"key of {file}", Path(file), {}) for file in self._files
        ]

    def folder(self, name):
        raise AssertionError("recordings need no other stage")

    def key(self, name):
        raise AssertionError("recordings need no other stage")

    def content(self, name, *names):
        raise AssertionError("recordings need no other stage")


def test_the_stage_takes_recordings_and_numbers_those_of_a_scene(
    recordings, tmp_path, scenes
):
    settings = RolloutSettings(recordings=str(recordings))
    (unit,) = stage.STAGE.plan(Inputs(settings, SOURCE, "training.tfrecord-0"), settings)
    target = tmp_path / "out"
    target.mkdir()

    report = stage.STAGE.work(unit, target, settings, lambda *_: None)

    assert unit.name == f"{SOURCE}-00000"
    found = [(each.scenario_id, each.index, each.seed) for each in read_rollouts(target)]
    one, other = scenes[0].scenario_id, scenes[1].scenario_id
    assert sorted(found) == sorted([(one, 0, 0), (one, 1, 2), (other, 0, 1)])
    index = pl.read_parquet(target / "index.parquet")
    assert index["scenario_id"].to_list() == [each[0] for each in found]
    assert (report["rollouts"], report["add_bias"]) == (3, 0.25)
    assert report["rules"] == "none"


def test_recordings_of_other_records_are_refused(recordings):
    settings = RolloutSettings(recordings=str(recordings))

    with pytest.raises(PlanError, match=rf"is of {SOURCE}, expected one of other"):
        stage.STAGE.plan(Inputs(settings, "other"), settings)


def test_without_recordings_keys_are_what_they_were():
    assert "recordings" not in key_values(RolloutSettings())
    assert stage.STAGE.reads(Path("root"), RolloutSettings()) == []


def test_with_recordings_other_settings_have_no_effect():
    settings = RolloutSettings(recordings="x", seed=3, count=7)

    (normal,) = stage.STAGE.normalize({"rollout": settings}).values()

    assert normal == RolloutSettings(recordings="x")


def test_view_and_export_read_a_recording(recordings, tmp_path, monkeypatch, scenes):
    monkeypatch.chdir(tmp_path)

    assert infgen("view", recordings / "a", "--out", "a.html") == 0
    assert scenes[0].scenario_id in Path("a.html").read_text()
    assert infgen("view", recordings / "a", "--rollouts", "3") == 2
    for to in ("parquet", "gpudrive"):
        assert infgen("export", recordings / "a", "--to", to, "--out", to) == 0
        assert any(Path(to).iterdir())


@pytest.mark.slow
def test_score_view_and_export_take_recordings_through_a_root(
    tmp_path, monkeypatch, source, scenes
):
    monkeypatch.chdir(tmp_path)
    split = source.name.split(".")[0]
    for seed in (0, 1):
        record(tmp_path / f"drives/{seed}", scenes[0], seed, source.name)

    words = ["--root", "R", "--records", "builtin", "--profile", "tiny"]
    sets = [f"reference.split={split}", "rollout.recordings=drives"]
    chosen = [part for word in sets for part in ("-s", word)]
    assert infgen("score", *words, *chosen) == 0

    rows = pl.read_parquet("R/latest/rollout/index.parquet")
    assert rows["rollout"].to_list() == [0, 1]
    assert infgen("view", "R", "--rollouts", "0,1", "--out", "x.html") == 0
    assert infgen("export", "--root", "R", "--to", "parquet", "--out", "table") == 0
    assert infgen("status", "--root", "R") == 0
