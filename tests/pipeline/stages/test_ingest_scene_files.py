"""Scene files of other sources on their way into the store."""

import dataclasses
import importlib
import pickle
import shutil
from pathlib import Path

import polars as pl
import pytest

from infgen.config import IngestSettings
from infgen.exports.scenarionet_scene import write_scene
from infgen.sources.towns import builtin_records
from pipeline.engine.layout import Root
from pipeline.engine.stage import Source, Unit
from pipeline.stages.ingest import STAGE
from pipeline.storage.scenes import read_scenes
from pipeline.storage.sources import scene_groups
from pipeline.storage.sources.changes import ChangedSourceError
from pipeline.storage.sources.source_files import find_sources
from pipeline.storage.splits import split_of
from tests.pipeline.stages.test_ingest import Files, no_progress

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture(scope="module")
def made(tmp_path_factory, crossing):
    """A folder of all kinds: training and validation, Argoverse 2 and ScenarioNet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        write = importlib.import_module("other_sources")
    folder = tmp_path_factory.mktemp("made")
    scene = dataclasses.replace(crossing(steps=60), now=49)
    write.write_motion(folder / "av2/val/m-1", scene)
    write.write_sensor(folder / "av2/train/log-1", crossing(steps=40))
    (folder / "net").mkdir()
    for name in ("a", "b"):
        named = dataclasses.replace(crossing(steps=40), scenario_id=name)
        # Named as ScenarioNet names a scene that was converted from WOMD.
        path = folder / "net" / f"sd_training.tfrecord-00000-of-01000_{name}.pkl"
        write_scene(path, named, "training")
    summary = folder / "net" / "dataset_summary.pkl"
    summary.write_bytes(pickle.dumps({"sd_a.pkl": {}}))
    return folder


def find(root, *patterns) -> tuple[Source, ...]:
    return find_sources([str(pattern) for pattern in patterns], Root(root))


def unit_of(source) -> Unit:
    (unit,) = STAGE.plan(Files(source), IngestSettings())
    return unit


def ingested(source, target, **values):
    report = STAGE.work(unit_of(source), target, IngestSettings(**values), no_progress)
    return report, pl.read_parquet(target / "index.parquet")


def test_a_mix_of_records_and_folders_becomes_groups_by_source_and_split(made, tmp_path):
    records = tmp_path / "records"
    records.mkdir()
    shutil.copy(builtin_records()[0], records)

    found = find(tmp_path / "root", made, records)

    assert [source.name for source in found] == [
        "training.argoverse2-00000-of-00001",
        "training.scenarionet-00000-of-00001",
        builtin_records()[0].name,
        "validation.argoverse2-00000-of-00001",
    ]
    assert [split_of(source.name) for source in found] == [
        *["training"] * 3,
        "validation",
    ]
    assert [len(source.parts) for source in found] == [1, 2, 0, 1]


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("av2/val", ["m-1"]),
        ("av2/val/m-1", ["m-1"]),
        ("av2/*/*", ["log-1", "m-1"]),
        ("av2/val/m-1/*.parquet", ["m-1"]),
        ("net/*.pkl", ["a.pkl", "b.pkl"]),
        ("net/*_a.pkl", ["a.pkl"]),
    ],
)
def test_scenes_are_named_by_file_folder_or_pattern(made, tmp_path, pattern, names):
    parts = [part for source in find(tmp_path, made / pattern) for part in source.parts]

    assert sorted(part["name"].replace("_", "/").split("/")[-1] for part in parts) == names


def test_the_index_says_what_a_scene_is_and_where_it_came_from(made, tmp_path):
    (source,) = find(tmp_path / "root", made / "av2/val")
    report, index = ingested(source, tmp_path / "unit")

    row = index.row(0, named=True)
    assert (row["scenario_id"], row["split"], row["steps"]) == ("m-1", "validation", 60)
    assert (row["file"], row["dataset"]) == ("val/m-1", "av2-motion")
    assert row["annotation_hz"] == 10
    assert row["signals"] == 0
    size = sum(path.stat().st_size for path in (made / "av2/val/m-1").iterdir())
    assert report["record_bytes"] == row["record_bytes"] == size


def test_the_history_of_stored_scenes_ends_with_a_token_where_stages_read_them(
    made, tmp_path
):
    (source,) = find(tmp_path / "root", made / "av2/val")
    ingested(source, tmp_path / "unit")

    (whole,) = read_scenes(tmp_path / "unit", aligned=False)
    (scene,) = read_scenes(tmp_path / "unit")
    assert (whole.now, whole.tracks.num_steps) == (49, 60)
    assert (scene.now, scene.tracks.num_steps) == (45, 56)
    assert (scene.tracks.xyz_m == whole.tracks.xyz_m[:, 4:]).all()
    assert len(scene.timestamps_s) == 56


def test_now_is_a_setting(made, tmp_path):
    (source,) = find(tmp_path / "root", made / "av2/val")
    ingested(source, tmp_path / "unit", now_step=20)

    (scene,) = read_scenes(tmp_path / "unit")
    assert scene.now == 20


def test_a_bad_file_is_quarantined_by_name_and_reason_and_the_rest_goes_on(made, tmp_path):
    shutil.copytree(made / "net", tmp_path / "net")
    bad = tmp_path / "net" / "sd_bad.pkl"
    mark = tmp_path / "was-run"
    bad.write_bytes(
        b"\x80\x04cbuiltins\nopen\nX\x07\x00\x00\x00was-runX\x01\x00\x00\x00w\x86R."
    )
    text = tmp_path / "net" / "sd_text.pkl"
    text.write_bytes(b"cos\nsystem\n(S'touch was-run'\ntR.")

    sources = find(tmp_path / "root", tmp_path / "net")
    rows = {}
    for number, source in enumerate(sources):
        target = tmp_path / str(number)
        ingested(source, target)
        for row in pl.read_parquet(target / "quarantine.parquet").iter_rows(named=True):
            rows[row["reason"].split(": ")[0]] = row["reason"]

    assert set(rows) == {"net/sd_bad.pkl", "net/sd_text.pkl"}
    assert "imports builtins.open" in rows["net/sd_bad.pkl"]
    assert "not a pickle of protocol 2" in rows["net/sd_text.pkl"]
    assert not mark.exists()
    assert not Path("was-run").exists()


def test_a_folder_without_a_map_is_quarantined(made, tmp_path):
    shutil.copytree(made / "av2/val", tmp_path / "val")
    next((tmp_path / "val/m-1").glob("*.json")).unlink()
    (tmp_path / "val/m-1/scenario_m-1.parquet").rename(
        tmp_path / "val/m-1/scenario_x.parquet"
    )

    (source,) = find(tmp_path / "root", tmp_path / "val")
    report, _ = ingested(source, tmp_path / "unit")
    quarantine = pl.read_parquet(tmp_path / "unit" / "quarantine.parquet")

    assert (report["scenes"], report["quarantined"]) == (0, 1)
    assert quarantine["reason"].item().startswith("val/m-1: folder has no map archive")


def test_the_identity_of_a_group_is_that_of_its_names_and_bytes(made, tmp_path):
    shutil.copytree(made, tmp_path / "copy")
    before = {s.name: s.fingerprint for s in find(tmp_path / "root", made)}
    copied = {s.name: s.fingerprint for s in find(tmp_path / "root", tmp_path / "copy")}
    path = tmp_path / "copy/av2/train/log-1/annotations.feather"
    path.write_bytes(path.read_bytes() + b"x")
    changed = {s.name: s.fingerprint for s in find(tmp_path / "root", tmp_path / "copy")}

    assert copied == before
    differ = {name for name, mark in changed.items() if mark != before[name]}
    assert differ == {"training.argoverse2-00000-of-00001"}


def test_a_scene_file_that_changes_while_its_group_is_read_is_told(made, tmp_path):
    shutil.copytree(made, tmp_path / "copy")
    (source,) = find(tmp_path / "root", tmp_path / "copy/av2/train")
    (path,) = (tmp_path / "copy").rglob("annotations.feather")
    path.write_bytes(path.read_bytes() + b"x")

    with pytest.raises(ChangedSourceError, match=f"a file of {source.name} changed after"):
        ingested(source, tmp_path / "unit")


def test_many_scenes_make_bounded_groups_and_new_ones_change_few(
    tmp_path, crossing, monkeypatch
):
    monkeypatch.setattr(scene_groups, "SCENES_PER_GROUP", 4)
    (tmp_path / "train").mkdir()
    write_scene(tmp_path / "train/sd_00.pkl", crossing(steps=12), "")
    for number in range(1, 40):
        shutil.copy(tmp_path / "train/sd_00.pkl", tmp_path / f"train/sd_{number:02d}.pkl")
    before = {s.name: s for s in find(tmp_path / "root", tmp_path / "train")}
    shutil.copy(tmp_path / "train/sd_00.pkl", tmp_path / "train/sd_new.pkl")
    after = {s.name: s for s in find(tmp_path / "root", tmp_path / "train")}

    assert sum(len(source.parts) for source in before.values()) == 40
    assert max(len(source.parts) for source in before.values()) <= 10
    changed = [name for name in after if after[name] != before.get(name)]
    assert len(changed) == 1


def test_units_name_no_folder_so_that_a_root_can_be_moved(made, tmp_path):
    shutil.copytree(made, tmp_path / "copy")
    units = [
        STAGE.plan(Files(*find(tmp_path / "root", folder)), IngestSettings())
        for folder in (made, tmp_path / "copy")
    ]

    for one, two in zip(*units, strict=True):
        assert (one.name, one.inputs) == (two.name, two.inputs)
