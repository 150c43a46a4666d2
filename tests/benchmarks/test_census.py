"""Benchmarks of size on a few scenes: every step of them."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

from pipeline.engine.layout import Root
from pipeline.engine.manifest import verify
from pipeline.storage.scenes import read_scenes

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SMALL = ("--files", "2", "--scenes", "3", "2", "--rollouts", "3", "--seconds", "8")
PER_UNIT = ("--scenes-per-unit", "1")


@pytest.fixture(scope="module")
def census(tmp_path_factory):
    """The folder of a root, and what the benchmark printed last."""
    folder = tmp_path_factory.mktemp("census")
    script = str(BENCHMARKS / "census.py")
    words = [*SMALL, *PER_UNIT, "--folder", str(folder), "--keep"]
    done = subprocess.run(
        [sys.executable, script, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    (made,) = folder.iterdir()
    return made, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_every_command_is_measured_on_a_root_of_the_size_asked_for(census):
    (root,) = census[1]["roots"]

    assert root["scenes"] == 2 * 3 + 1 * 2
    assert {"plan", "status", "gc", "verify", "run ingest", "run report"} <= set(
        root["rows"]
    )
    assert all(cpu_s > 0 and mib > 10 for _, cpu_s, mib in root["rows"].values())
    assert root["found"]["train: index and first batch"]["scenes"] == 6
    assert root["found"]["rollout: split into units"]["units"] == 2
    assert root["found"]["dask"]["tasks"] == 2


@pytest.mark.slow
def test_copied_units_are_as_the_pipeline_writes_them(census):
    root = Root(census[0] / "root")

    assert list(verify(root, full=True)) == []
    index = pl.read_parquet(root.latest_folder("ingest") / "index.parquet")
    assert index["scenario_id"].n_unique() == len(index) == 8
    assert index["source"].n_unique() == 3
    units = [folder for stage, folder in root.made() if folder.parent.name == "units"]
    scenes = [len(list(read_scenes(unit))) for unit in units if unit.parts[-3] == "ingest"]
    assert sorted(scenes) == [2, 3, 3]


@pytest.mark.parametrize(
    ("points", "grows"),
    [
        ([(10, 1.0), (110, 2.0), (210, 3.0)], False),
        ([(10, 1.0), (110, 2.0), (210, 13.0)], True),
        ([(10, 1.0), (110, 1.0), (210, 1.1)], False),
        ([(10, 1.0), (110, 90.0)], False),
    ],
)
def test_a_command_grows_where_a_further_scene_costs_more_than_before(
    monkeypatch, points, grows
):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    census = importlib.import_module("census")

    assert census.grows(points) is grows


@pytest.mark.slow
def test_files_of_tiny_scenes_are_ingested_and_counted():
    script = str(BENCHMARKS / "ingest_files.py")
    words = [sys.executable, script, "--files", "2"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    assert (figures["files"], figures["scenes_per_file"]) == (2, 60)
    assert figures["files_per_unit"] <= 6
    assert figures["cpu_s_per_unit"] > 0


@pytest.mark.slow
def test_two_versions_of_the_code_are_measured_on_the_same_records():
    script, checkout = str(BENCHMARKS / "two_versions.py"), str(BENCHMARKS.parent)
    words = [sys.executable, script, checkout, checkout, "--files", "1"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    older, newer = figures["older"], figures["newer"]
    assert older["unit"].keys() == newer["unit"].keys() == {"ingest", "tokenize"}
    assert older["unit"]["tokenize"] == newer["unit"]["tokenize"]
    assert all(cpu_s > 0 for (cpu_s,) in newer["cpu_s"].values())
    assert {"status", "plan", "verify", "gc", "train, one step"} < newer["cpu_s"].keys()
