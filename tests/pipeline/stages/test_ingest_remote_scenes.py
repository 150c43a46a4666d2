"""Scene files at URLs are found, identified and read as local ones are."""

import shutil

import fsspec
import pytest

from infgen.config import IngestSettings
from infgen.errors import ConfigError
from infgen.sources.registry import find_below
from infgen.sources.remote_files import file_bytes
from infgen.sources.remote_scenes import find_below_url
from infgen.sources.tfrecord import RecordError
from pipeline.engine.layout import Root
from pipeline.storage.scenes import read_scenes
from pipeline.storage.sources.fingerprints import FingerprintCache
from pipeline.storage.sources.raw_scenes import iter_raw_scenes
from pipeline.storage.sources.source_files import find_records
from tests.pipeline.stages.test_ingest import no_progress
from tests.pipeline.stages.test_ingest_scene_files import STAGE, find, made, unit_of
from tests.sources.test_womd import differences

__all__ = ["made"]
URL = "memory://scenes"


@pytest.fixture
def remote(made, tmp_path):
    """The made scenes in the memory of fsspec, and a folder with the same."""
    system = fsspec.filesystem("memory")
    system.put(str(made), "/scenes", recursive=True)
    lidar = "/scenes/av2/train/log-1/sensors/lidar/1.feather"
    system.pipe(lidar, b"ARROW1 not annotations")
    local = tmp_path / "scenes"
    shutil.copytree(made, local)
    yield local
    system.rm("/scenes", recursive=True)


def names(found):
    return [(scene.source, scene.files.name, scene.label) for scene in found]


def test_the_same_scenes_are_found_below_a_url_as_below_a_folder(remote):
    found = list(find_below_url(URL))

    assert names(found) == names(find_below(str(remote)))
    paths = [path for scene in found for path in scene.files.paths]
    assert all(path.startswith("memory:///scenes/") for path in paths)
    assert "memory:///scenes/av2/train/log-1/annotations.feather" in paths


def test_scenes_read_from_urls_are_those_of_the_local_files(remote):
    for one, other in zip(find_below_url(URL), find_below(str(remote)), strict=True):
        found, expected = one.read(), other.read()

        assert differences(found.scene, expected.scene) == []
        assert found[1:] == expected[1:]
        assert sum(map(file_bytes, one.files.paths)) == sum(
            map(file_bytes, other.files.paths)
        )


@pytest.mark.parametrize(
    ("pattern", "count"),
    [
        ("", 4),
        ("/net", 2),
        ("/net/*.pkl", 2),
        ("/av2/*/*", 2),
        ("/av2/val/m-1", 1),
        ("/av2/val/m-1/scenario_m-1.parquet", 1),
    ],
)
def test_files_folders_and_patterns_name_scenes(remote, pattern, count):
    records = find_records([f"{URL}{pattern}"])

    assert records.urls == []
    assert len(records.scenes) == count
    local = find_records([f"{remote}{pattern}"])
    assert names(records.scenes) == names(local.scenes)


def test_tfrecords_beside_scenes_are_told_from_them(remote):
    system = fsspec.filesystem("memory")
    system.pipe("/scenes/net/training.tfrecord-00000-of-00001", b"")

    records = find_records([f"{URL}/net"])

    assert [url.rsplit("/", 1)[1] for url in records.urls] == [
        "training.tfrecord-00000-of-00001"
    ]
    assert len(records.scenes) == 2


def test_a_folder_without_scenes_and_one_that_is_not_there_are_refused(remote):
    for pattern in (f"{URL}/av2/train/log-1/sensors", f"{URL}/nothing", f"{URL}/no/*.pkl"):
        with pytest.raises(ConfigError, match="no records match"):
            find_records([pattern])


def test_groups_of_remote_scenes_are_ingested_as_local_ones(remote, tmp_path):
    here, there = find(tmp_path / "one", remote), find(tmp_path / "two", URL)

    assert [source.name for source in there] == [source.name for source in here]
    for number, (one, other) in enumerate(zip(here, there, strict=True)):
        folders = tmp_path / f"here-{number}", tmp_path / f"there-{number}"
        reports = [
            STAGE.work(unit_of(source), folder, IngestSettings(), no_progress)
            for source, folder in zip((one, other), folders, strict=True)
        ]
        assert reports[0]["scenes"] == reports[1]["scenes"] > 0
        assert reports[0]["record_bytes"] == reports[1]["record_bytes"]
        for found, expected in zip(*map(read_scenes, folders), strict=True):
            assert differences(found, expected) == []


def test_another_content_is_another_group_and_the_same_is_the_same(remote, tmp_path):
    first = find(tmp_path, f"{URL}/net")
    again = find(tmp_path, f"{URL}/net")
    system = fsspec.filesystem("memory")
    path = system.glob("/scenes/net/sd_*_a.pkl")[0]
    system.pipe(path, system.cat(path) + b"more")

    assert again == first
    assert find(tmp_path, f"{URL}/net")[0].fingerprint != first[0].fingerprint


def test_the_label_of_a_remote_scene_is_read_once(remote, tmp_path, monkeypatch):
    scene = next(find_below_url(f"{URL}/net"))
    cache = FingerprintCache(Root(tmp_path))
    expected = cache.label(scene)
    cache.save()
    monkeypatch.setattr("infgen.sources.scenarionet.label", None)  # Would fail if called.

    assert FingerprintCache(Root(tmp_path)).label(scene) == expected


def test_a_damaged_remote_scene_is_named(remote):
    system = fsspec.filesystem("memory")
    path = system.glob("/scenes/net/sd_*_a.pkl")[0]
    system.pipe(path, system.cat(path)[:500])
    bad = []

    records = find_records([f"{URL}/net"])
    raw = list(iter_raw_scenes(records, bad))
    with pytest.raises(RecordError, match="_a"):
        raw[0].decode()
    assert raw[1].decode().scenario_id == "b"
