"""A scene that several files of a split hold is made something of only once."""

import gzip
import json
import os
from itertools import islice
from pathlib import Path

import polars as pl
import pytest

from infgen.scene import Scene
from infgen.sources.tfrecord import iter_records
from pipeline.engine.events import Events
from pipeline.engine.inputs import FinishedInputs
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.engine.runner import RunOptions, run
from pipeline.engine.stage import FinishedUnit
from pipeline.settings.request import Request
from pipeline.settings.stages_file import DEFAULT_FILE
from pipeline.storage.duplicates import read_task_scenes, scenes_task, unique_rows
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.splits import spread_evenly
from pipeline.storage.zarr_store import write_records
from tests.sources.records import write_tfrecord

FIRST = "validation.tfrecord-00000-of-00002"
SECOND = "validation.tfrecord-00001-of-00002"
TWIN = f"{FIRST}.gz"


def file_of(path: Path, scenes: int, *duplicate_rows: list[int]) -> FinishedUnit:
    report = {
        "scenes": scenes,
        **({"duplicate_rows": list(duplicate_rows)} if duplicate_rows else {}),
    }
    return FinishedUnit(path.name, "key", path, report)


@pytest.fixture
def ingested(tmp_path, scenes):
    """A file of three scenes in two groups."""
    for at, part in enumerate((scenes[:2], scenes[2:])):
        path = tmp_path / f"scenes-00{at}.zarr"
        write_records(path, part, Scene, SCENES_SCHEMA, compress=True)
    return tmp_path


def test_without_duplicates_all_scenes_count_and_tasks_say_no_more_than_where(tmp_path):
    done = file_of(tmp_path, 3)

    assert unique_rows(done) == [0, 1, 2]
    assert scenes_task(done) == {"scenes": str(tmp_path)}


@pytest.mark.parametrize(
    ("duplicate_rows", "rows"),
    [([], [0, 1, 2]), ([[1, 2]], [0, 2]), ([[0, 1], [2, 3]], [1]), ([[0, 3]], [])],
)
def test_who_reads_the_scenes_that_a_task_names_reads_those_that_count(
    ingested, scenes, duplicate_rows, rows
):
    done = file_of(ingested, 3, *duplicate_rows)

    task = json.loads(json.dumps(scenes_task(done)))

    assert unique_rows(done) == rows
    found = [scene.scenario_id for scene in read_task_scenes(task)]
    assert found == [scenes[row].scenario_id for row in rows]


def test_scenes_are_taken_evenly_from_those_that_count(tmp_path):
    files = [file_of(tmp_path, 6, [1, 3]), file_of(tmp_path, 4, [0, 4])]

    assert spread_evenly(files, 0) == [[0, 3, 4, 5], []]
    assert spread_evenly(files, 2) == [[0, 4], []]


def made(folder: Path, *names: str) -> tuple[Root, dict[str, FinishedInputs]]:
    """Make tokens and a reference of some files."""
    root = Root(folder / "root")
    root.path.mkdir(parents=True)
    records = [str(folder.parent / "records" / name) for name in names]
    taken = ("build-vocab.initial_weights=builtin",)
    request = Request(root, DEFAULT_FILE, None, tuple(records), taken)
    plan = request.plan(["tokenize", "reference"], {})
    results = run(plan, RunOptions(), Events(root))
    assert [result.errors for result in results] == [{}] * len(results)
    return root, {name: FinishedInputs(root, plan[name]) for name in plan.stages}


@pytest.mark.slow
def test_a_file_that_is_there_twice_changes_nothing(tmp_path, source, monkeypatch):
    # What syncing is for is not seen by a test.
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    first, second, third = (each.data for each in islice(iter_records(source), 3))
    folder = tmp_path / "records"
    folder.mkdir()
    write_tfrecord(folder / FIRST, [first, second])
    write_tfrecord(folder / SECOND, [third])
    write_tfrecord(folder / TWIN, [first, second])
    assert gzip.decompress((folder / TWIN).read_bytes()) == (folder / FIRST).read_bytes()

    root, plain = made(tmp_path / "plain", FIRST, SECOND)
    again, twice = made(tmp_path / "twice", FIRST, SECOND, TWIN)

    report = read_manifest(again.latest_folder("ingest"))["report"]
    assert (report["scenes"], report["duplicates"]) == (5, 2)
    assert twice["tokenize"].units("ingest")[1].report["duplicate_rows"] == [[0, 2]]
    for stage in ("build-vocab", "tokenize", "reference"):
        keys = [
            {
                unit["name"]: unit["key"]
                for unit in read_manifest(each.latest_folder(stage))["units"]
                if unit["name"] != TWIN
            }
            for each in (root, again)
        ]
        assert keys[0] == keys[1]
    names = [
        pl.read_parquet(each.latest_folder("tokenize") / "index.parquet")[
            "scenario_id"
        ].to_list()
        for each in (root, again)
    ]
    assert len(names[0]) == 3
    assert names[0] == names[1]
    counts = [each.latest_folder("reference") / "counts.zarr" for each in (root, again)]
    files = [
        {
            path.relative_to(each): path.read_bytes()
            for path in each.rglob("*")
            if path.is_file()
        }
        for each in counts
    ]
    assert files[0] == files[1]
    played = [
        sum(map(len, spread_evenly(each["tokenize"].units("ingest"), 0)))
        for each in (plain, twice)
    ]
    assert played == [3, 3]
