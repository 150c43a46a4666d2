import hashlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from infgen.config import IngestSettings
from infgen.sources.tfrecord import frame
from infgen.sources.womd import decode_scene
from pipeline.engine.stage import FinishedUnit, Inputs, Source, Unit
from pipeline.stages import ingest
from pipeline.stages.ingest import STAGE
from pipeline.storage.scenes import read_scenes
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from tests.sources.records import changed, small_scenario, write_tfrecord
from tests.sources.test_womd import differences, twin_tracks


def record(scenario_id: str, steps: int = 12) -> bytes:
    return small_scenario(scenario_id, steps).SerializeToString()


def no_progress(done, total, note=""):
    pass


class Files(Inputs):
    """What a stage that reads only source files may ask for."""

    def __init__(self, *sources: Source):
        self._sources = sources

    @property
    def sources(self):
        return self._sources


def run_unit(path: Path, target: Path, **values) -> FinishedUnit:
    unit = Unit(path.name, {"source": file_identity(path)}, {"url": str(path)})
    report = STAGE.work(unit, target, IngestSettings(**values), no_progress)
    return FinishedUnit(path.name, "key", target, report)


def run_stage(folder: Path, files: dict[str, list[bytes]]) -> Path:
    """Ingest files and gather them; return the stage's folder."""
    done = [
        run_unit(write_tfrecord(folder / name, records), folder / f"{name}.unit")
        for name, records in files.items()
    ]
    STAGE.finish(Files(), done, folder / "all", IngestSettings(), no_progress)
    return folder / "all"


def fingerprint(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def three(tmp_path):
    records = [record("a"), record("b", steps=20), record("c")]
    return write_tfrecord(tmp_path / "training.tfrecord-00000-of-00001.gz", records)


def test_scenes_come_back_bit_for_bit_in_the_order_of_the_records(tmp_path, three):
    done = run_unit(three, tmp_path / "unit")

    found = list(read_scenes(done.path, aligned=False))

    expected = [decode_scene(record(i, n)) for i, n in (("a", 12), ("b", 20), ("c", 12))]
    assert [differences(*pair) for pair in zip(found, expected, strict=True)] == [[]] * 3


def test_the_index_says_where_each_scene_lies_and_came_from(tmp_path, three):
    done = run_unit(three, tmp_path / "unit", max_scenes_per_shard=2)

    index = pl.read_parquet(done.path / "index.parquet")

    assert index["scenario_id"].to_list() == ["a", "b", "c"]
    assert index["group"].to_list() == [f"scenes-00{i}.zarr" for i in (0, 0, 1)]
    assert index["row"].to_list() == [0, 1, 0]
    assert index["record"].to_list() == [0, 1, 2]
    assert index["offset"].to_list()[:2] == [0, len(record("a")) + 16]
    assert index["record_bytes"].to_list()[0] == len(record("a"))
    assert index["steps"].to_list() == [12, 20, 12]
    assert set(index["split"]) == {"training"}
    assert set(index["source"]) == {three.name}
    assert index.select("agents", "features", "points", "signals").row(0) == (2, 8, 29, 12)


def test_the_report_counts_what_came_and_what_it_takes(tmp_path, three):
    report = run_unit(three, tmp_path / "unit").report

    raw = sum(len(record(i, n)) for i, n in (("a", 12), ("b", 20), ("c", 12)))
    assert report["split"] == "training"
    assert (report["scenes"], report["quarantined"]) == (3, 0)
    assert report["record_bytes"] == raw
    files = [path for path in (tmp_path / "unit").rglob("*") if path.is_file()]
    assert report["disk_bytes"] == sum(path.stat().st_size for path in files)


def test_groups_are_flushed_before_they_grow_too_big(tmp_path, three, monkeypatch):
    monkeypatch.setattr(ingest, "GROUP_BYTES", 1)

    done = run_unit(three, tmp_path / "unit")

    assert len(list(done.path.glob("scenes-*.zarr"))) == 3
    assert [scene.scenario_id for scene in read_scenes(done.path)] == ["a", "b", "c"]


def test_more_than_ten_groups_keep_their_order(tmp_path):
    names = [f"s{i}" for i in range(12)]
    path = write_tfrecord(tmp_path / "t.tfrecord", [record(name) for name in names])

    done = run_unit(path, tmp_path / "unit", max_scenes_per_shard=1)

    assert [scene.scenario_id for scene in read_scenes(done.path)] == names


def test_bad_records_are_rows_of_the_quarantine_and_the_rest_goes_on(tmp_path):
    bad = changed(twin_tracks, "bad")
    path = write_tfrecord(
        tmp_path / "t.tfrecord", [record("a"), bad, b"\xff\xff", record("b")]
    )
    path.write_bytes(path.read_bytes() + b"half a hea")

    done = run_unit(path, tmp_path / "unit")

    quarantine = pl.read_parquet(done.path / "quarantine.parquet")
    first = len(record("a")) + 16
    end = path.stat().st_size - 10
    assert quarantine.drop("reason").rows() == [
        ("t.tfrecord", 1, first),
        ("t.tfrecord", 2, first + len(bad) + 16),
        ("t.tfrecord", 4, end),
    ]
    assert quarantine["reason"][0] == "two tracks have id 7"
    assert quarantine["reason"][2] == ("file ends inside a record's header: 10 of 12 bytes")
    assert [scene.scenario_id for scene in read_scenes(done.path)] == ["a", "b"]
    assert done.report["quarantined"] == 3


def test_an_id_that_comes_twice_in_a_file_is_quarantined(tmp_path):
    path = write_tfrecord(tmp_path / "t.tfrecord", [record("a"), record("b"), record("a")])

    done = run_unit(path, tmp_path / "unit")

    quarantine = pl.read_parquet(done.path / "quarantine.parquet")
    assert quarantine["record"].to_list() == [2]
    assert quarantine["reason"].to_list() == ["duplicate id a: record 0 has it already"]
    assert done.report["scenes"] == 2


def test_a_file_without_a_usable_record_gives_empty_tables_with_their_columns(tmp_path):
    path = tmp_path / "t.tfrecord"
    path.write_bytes(b"")

    done = run_unit(path, tmp_path / "unit")

    index = pl.read_parquet(done.path / "index.parquet")
    assert len(index) == 0
    assert index.schema["scenario_id"] == pl.String
    assert index.schema["offset"] == pl.Int64
    quarantine = pl.read_parquet(done.path / "quarantine.parquet")
    assert quarantine.rows() == [("t.tfrecord", 0, 0, "file is empty")]
    assert list(read_scenes(done.path)) == []


def test_a_clean_file_has_an_empty_quarantine_with_its_columns(tmp_path, three):
    done = run_unit(three, tmp_path / "unit")

    quarantine = pl.read_parquet(done.path / "quarantine.parquet")

    assert len(quarantine) == 0
    assert quarantine.columns == ["source", "record", "offset", "reason"]


def test_a_limit_takes_the_first_scenes_of_each_file(tmp_path, three):
    done = run_unit(three, tmp_path / "unit", max_scenes_per_file=2)

    assert [scene.scenario_id for scene in read_scenes(done.path)] == ["a", "b"]


def test_the_same_file_gives_the_same_bytes(tmp_path, three):
    first = run_unit(three, tmp_path / "first")
    second = run_unit(three, tmp_path / "second")

    assert fingerprint(first.path) == fingerprint(second.path)


def test_one_unit_is_planned_per_file_with_its_fingerprint():
    sources = [Source("gs://b/x.tfrecord", "x.tfrecord", "f1"), Source("/y", "y", "f2")]

    units = STAGE.plan(Files(*sources), IngestSettings())

    assert [unit.name for unit in units] == ["x.tfrecord", "y"]
    assert units[0].inputs == {"source": "f1"}
    assert units[0].task == {"url": "gs://b/x.tfrecord"}


def test_finish_joins_the_tables_of_all_files(tmp_path):
    bad = changed(twin_tracks, "bad")
    files = {"a.tfrecord": [record("a")], "b.tfrecord": [bad, record("b")]}

    folder = run_stage(tmp_path, files)

    index = pl.read_parquet(folder / "index.parquet")
    assert index.select("scenario_id", "source").rows() == [
        ("a", "a.tfrecord"),
        ("b", "b.tfrecord"),
    ]
    assert not index["duplicate"].any()
    quarantine = pl.read_parquet(folder / "quarantine.parquet")
    assert quarantine["source"].to_list() == ["b.tfrecord"]
    assert len(pl.read_parquet(folder / "duplicates.parquet")) == 0


def test_an_id_that_several_files_of_a_split_hold_is_named_and_marked(tmp_path):
    files = {
        "training.tfrecord-0": [record("x"), record("a")],
        "training.tfrecord-1": [record("b"), record("x")],
    }

    folder = run_stage(tmp_path, files)

    index = pl.read_parquet(folder / "index.parquet")
    assert index["duplicate"].to_list() == [False, False, False, True]
    (row,) = pl.read_parquet(folder / "duplicates.parquet").rows(named=True)
    assert row == {
        "source": "training.tfrecord-1",
        "record": 1,
        "offset": len(record("b")) + 16,
        "reason": "scenario x is in training.tfrecord-0 too: left out",
        "scenario_id": "x",
        "first_source": "training.tfrecord-0",
        "first_record": 0,
    }


def test_an_id_that_two_splits_hold_is_named_and_counts_in_both(tmp_path):
    files = {
        "training.tfrecord-0": [record("x")],
        "validation.tfrecord-0": [record("x")],
        "validation.tfrecord-1": [record("x")],
    }

    folder = run_stage(tmp_path, files)

    index = pl.read_parquet(folder / "index.parquet")
    assert index["duplicate"].to_list() == [False, False, True]
    duplicates = pl.read_parquet(folder / "duplicates.parquet")
    assert duplicates.select("source", "reason", "first_source").rows() == [
        (
            "validation.tfrecord-0",
            "scenario x is in training.tfrecord-0 too: both count",
            "training.tfrecord-0",
        ),
        (
            "validation.tfrecord-1",
            "scenario x is in validation.tfrecord-0 too: left out",
            "validation.tfrecord-0",
        ),
    ]


def test_the_report_says_which_rows_of_which_file_do_not_count(tmp_path):
    names = ["training.tfrecord-0", "training.tfrecord-0.gz", "training.tfrecord-1"]
    records = [[record(i) for i in ids] for ids in ("abcd", "abcd", "cxbad")]
    done = [
        run_unit(write_tfrecord(tmp_path / name, each), tmp_path / f"{name}.unit")
        for name, each in zip(names, records, strict=True)
    ]

    report = STAGE.finish(Files(), done, tmp_path / "all", IngestSettings(), no_progress)

    assert report == {
        "scenes": 13,
        "quarantined": 0,
        "duplicates": 8,
        "units": {
            "training.tfrecord-0.gz": {"duplicate_rows": [[0, 4]]},
            "training.tfrecord-1": {"duplicate_rows": [[0, 1], [2, 5]]},
        },
    }


def test_the_report_of_files_without_duplicates_names_no_file(tmp_path, three):
    done = [run_unit(three, tmp_path / "unit")]

    report = STAGE.finish(Files(), done, tmp_path / "all", IngestSettings(), no_progress)

    assert report == {"scenes": 3, "quarantined": 0, "duplicates": 0}


def test_a_stage_without_files_has_empty_tables(tmp_path):
    folder = run_stage(tmp_path, {})

    for name in ("index", "quarantine", "duplicates"):
        assert len(pl.read_parquet(folder / f"{name}.parquet")) == 0


@settings(
    deadline=None,
    max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_damaged_file_never_stops_its_unit(tmp_path_factory, data):
    tmp_path = tmp_path_factory.mktemp("files")
    whole = bytearray(b"".join(frame(record(name)) for name in "abc"))
    for _ in range(data.draw(st.integers(1, 5))):
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path = tmp_path / "t.tfrecord"
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])

    done = run_unit(path, tmp_path / "unit")

    kept = [scene.scenario_id for scene in read_scenes(done.path)]
    quarantine = pl.read_parquet(done.path / "quarantine.parquet")
    assert len(kept) == done.report["scenes"]
    assert len(quarantine) == done.report["quarantined"]
    assert len(kept) == 3 or len(quarantine) or path.stat().st_size < len(whole)
    assert all(quarantine["reason"].str.len_chars() > 0)


def test_array_bytes_of_a_scene_are_all_counted():
    scene = decode_scene(record("a"))

    tracks = 2 * (4 + 1) + 2 * 12 * (12 + 4 + 8 + 12 + 1)
    assert ingest.num_bytes(scene.tracks) == tracks
    assert ingest.num_bytes(scene) > tracks + np.asarray(scene.timestamps_s).nbytes
