"""Records that are replaced while they are read."""

import json

import pytest

from infgen.sources.womd_write import encode_scenario
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.runner import RunOptions, run
from pipeline.settings.request import Request
from pipeline.settings.stages_file import DEFAULT_FILE
from pipeline.stages import ingest_records
from tests.sources.records import write_tfrecord


@pytest.fixture
def records(scenes):
    return [encode_scenario(scene) for scene in scenes]


@pytest.fixture
def ingest(tmp_path):
    """``ingest(path)``: plan stage ``ingest`` of a file; what it gives makes the stage."""
    root = Root(tmp_path / "root")

    def plan(path):
        planned = Request(root, DEFAULT_FILE, None, (str(path),), ()).plan(("ingest",), {})
        return lambda: run(planned, RunOptions(), Events(root))[0]

    plan.root = root
    return plan


def test_a_file_that_is_replaced_after_it_was_planned_is_told_and_not_kept(
    ingest, tmp_path, records
):
    path = write_tfrecord(tmp_path / "training.tfrecord-0", records[:2])
    make = ingest(path)
    write_tfrecord(tmp_path / "fresh", records[1:]).replace(path)

    refused = make()
    made = ingest(path)()

    (error,) = refused.errors.values()
    assert error.startswith(f"ChangedSourceError: {path} changed after this run had begun")
    assert "run again when it no longer changes" in error
    assert made.state == "made"
    assert len(list(ingest.root.made())) == 2, "one unit and the stage, of the new file"


def test_a_file_that_is_written_over_while_it_is_read_is_told(
    ingest, tmp_path, records, monkeypatch
):
    path = write_tfrecord(tmp_path / "training.tfrecord-0", records[:2])
    decode = ingest_records.scene_or_bad_record

    def write_over(record):
        with path.open("r+b") as file:
            file.seek(-1, 2)
            file.write(b"\0")
        return decode(record)

    make = ingest(path)
    monkeypatch.setattr(ingest_records, "scene_or_bad_record", write_over)

    assert "changed after this run had begun" in make().errors[path.name]
    assert not list(ingest.root.made())


def test_a_file_that_is_removed_after_it_was_planned_is_named(ingest, tmp_path, records):
    path = write_tfrecord(tmp_path / "training.tfrecord-0", records[:2])
    make = ingest(path)
    path.unlink()

    assert str(path) in make().errors[path.name]
    assert json.loads(ingest.root.attempt("ingest").read_text())["failed"]
