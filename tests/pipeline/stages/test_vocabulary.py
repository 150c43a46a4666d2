import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from infgen.config import IngestSettings, VocabSettings
from infgen.scene import AgentType, Scene
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.engine.atomic import StoreError
from pipeline.engine.plan import PlanError
from pipeline.engine.stage import FinishedUnit, Unit
from pipeline.stages import ingest, vocabulary
from pipeline.stages.vocabulary import load_vocabularies
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from pipeline.storage.weights import vocabulary_fingerprint
from pipeline.storage.zarr_store import write_records

SETTINGS = VocabSettings(num_motion_tokens=96, num_map_tokens=48)
SHARED = Path(__file__).parents[3] / "../shared/data/womd"


@dataclass
class Ingested:
    """Inputs of the stage: ingested files."""

    files: list[FinishedUnit]
    sources: tuple = ()

    def units(self, name):
        return {"ingest": self.files}[name]

    def folder(self, name):
        raise AssertionError("the stage reads units only")

    def key(self, name):
        raise AssertionError("the stage reads units only")

    def content(self, name, *names):
        raise AssertionError("the stage reads units only")


def no_progress(done, total, note=""):
    pass


def fingerprint(folder):
    return vocabulary_fingerprint(*load_vocabularies(folder))


def ingested(folder, files):
    """Write scenes as ingested files: ``{file name: scenes}``."""
    done = []
    for name, scenes in files.items():
        path = folder / name
        path.mkdir(parents=True)
        write_records(path / "scenes-000.zarr", scenes, Scene, SCENES_SCHEMA, compress=True)
        done.append(FinishedUnit(name, f"key of {name}", path, {"scenes": len(scenes)}))
    return Ingested(done)


def build(inputs, folder, settings=SETTINGS, order=1):
    """Run the whole stage in process."""
    units = []
    for unit in vocabulary.plan(inputs, settings)[::order]:
        target = folder / "units" / unit.name
        target.mkdir(parents=True)
        report = vocabulary.work(unit, target, settings, no_progress)
        units.append(FinishedUnit(unit.name, f"key of {unit.name}", target, report))
    target = folder / "vocab"
    target.mkdir()
    figures = vocabulary.finish(inputs, units[::order], target, settings, no_progress)
    return target, figures


def all_bytes(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture
def traffic(drive, crossing):
    """Scenes with vehicles at many speeds, and one with all kinds."""

    def build(count, first=0):
        scenes = [drive(speed_mps=3.0 + 1.7 * number) for number in range(count - 1)]
        named = [crossing(), *scenes]
        return [
            dataclasses.replace(scene, scenario_id=f"scene {first + number}")
            for number, scene in enumerate(named)
        ]

    return build


@pytest.fixture
def two_splits(tmp_path, traffic):
    files = {
        "training.tfrecord-0": traffic(5),
        "training.tfrecord-1": traffic(4, first=5),
        "validation.tfrecord-0": traffic(3, first=9),
        "testing.tfrecord-0": traffic(2, first=12),
    }
    return ingested(tmp_path / "ingest", files)


def test_files_of_the_two_splits_are_units_with_their_roles(two_splits):
    units = vocabulary.plan(two_splits, SETTINGS)
    roles = {unit.name: unit.task["role"] for unit in units}
    assert roles == {
        "training.tfrecord-0": "learn",
        "training.tfrecord-1": "learn",
        "validation.tfrecord-0": "held-out",
    }
    assert units[0].inputs == {"scenes": "key of training.tfrecord-0", "role": "learn"}
    json.dumps([unit.task for unit in units])


def test_without_a_split_to_learn_from_the_error_names_those_there_are(two_splits):
    settings = dataclasses.replace(SETTINGS, split="trainig")
    with pytest.raises(PlanError, match="testing, training, validation"):
        vocabulary.plan(two_splits, settings)


def test_vocabularies_that_are_taken_need_nothing_to_learn_from(two_splits):
    settings = dataclasses.replace(SETTINGS, split="trainig", initial_weights="builtin")

    (unit,) = vocabulary.plan(two_splits, settings)

    assert (unit.name, unit.task["role"]) == ("validation.tfrecord-0", "held-out")
    with pytest.raises(PlanError, match="no file of split 'trainig'"):
        vocabulary.plan(two_splits, dataclasses.replace(settings, validation_split="none"))


def test_vocabularies_come_back_as_they_were_written_with_a_report(two_splits, tmp_path):
    folder, figures = build(two_splits, tmp_path)
    motion, roads = load_vocabularies(folder)
    assert isinstance(motion, MotionVocabulary)
    assert isinstance(roads, MapVocabulary)
    assert (motion.num_motion_tokens, roads.num_map_tokens) == (96, 48)
    report = json.loads((folder / "report.json").read_text())
    assert report["scenes"] == {"learn": 9, "held-out": 3}
    assert report["validation_split"] == "3 scenes of split validation"
    for kind in AgentType:
        if kind != AgentType.OTHER:
            row = report["motion"][kind.name.lower()]
            assert row["real"] + row["mirrored"] + row["made"] == 96
            assert row["real"] == motion.real[kind].sum() > 0
            assert row["beyond_limits"] == 0
            assert row["held_out_error_m"]["mean"] < 0.2
    assert figures["real"]["vehicle"] == report["motion"]["vehicle"]["real"]
    assert "<svg" in (folder / "report.html").read_text()


def test_a_logged_speed_is_written_without_error(two_splits, tmp_path):
    folder, _ = build(two_splits, tmp_path)
    motion, _ = load_vocabularies(folder)
    ends = motion.end_pose[AgentType.VEHICLE][motion.real[AgentType.VEHICLE], 0]
    for speed_mps in (3.0, 4.7, 6.4, 8.1):
        assert np.abs(ends - speed_mps / 2).min() < 1e-3


def test_bytes_do_not_depend_on_the_order_of_units(two_splits, tmp_path):
    one, _ = build(two_splits, tmp_path / "one")
    two, _ = build(two_splits, tmp_path / "two", order=-1)
    assert all_bytes(one) == all_bytes(two)


def test_bytes_of_vocabularies_do_not_depend_on_how_scenes_are_spread_over_files(
    tmp_path, traffic
):
    scenes = traffic(8)
    one = ingested(tmp_path / "a", {"training.tfrecord-0": scenes})
    two = ingested(
        tmp_path / "b",
        {"training.tfrecord-0": scenes[5:], "training.tfrecord-1": scenes[:5]},
    )
    folders = [
        build(inputs, tmp_path / name)[0] for name, inputs in (("c", one), ("d", two))
    ]
    assert fingerprint(folders[0]) == fingerprint(folders[1])


def test_the_fingerprint_tells_vocabularies_apart(two_splits, tmp_path):
    one, _ = build(two_splits, tmp_path / "one")
    other = dataclasses.replace(SETTINGS, seed=1)
    two, _ = build(two_splits, tmp_path / "two", other)
    same, _ = build(two_splits, tmp_path / "three")
    assert fingerprint(one) == fingerprint(same)
    assert fingerprint(one) != fingerprint(two)


def test_without_a_held_out_split_some_scenes_are_held_out_by_their_hash(tmp_path, traffic):
    files = ingested(tmp_path / "ingest", {"training.tfrecord-0": traffic(16)})
    folder, _ = build(files, tmp_path)
    report = json.loads((folder / "report.json").read_text())
    validation_split = report["scenes"]["held-out"]
    assert 0 < validation_split < 8
    assert report["scenes"]["learn"] == 16 - validation_split
    assert "held out by the hash" in report["validation_split"]
    assert report["motion"]["vehicle"]["held_out_tokens"] > 0


def test_scenes_without_cyclists_or_maps_still_give_whole_vocabularies(
    tmp_path, drive, build_map
):
    bare = [
        dataclasses.replace(drive(road_map=build_map([])), scenario_id=str(number))
        for number in range(3)
    ]
    files = {"training.tfrecord-0": bare[:2], "validation.tfrecord-0": bare[2:]}
    folder, figures = build(ingested(tmp_path / "ingest", files), tmp_path)
    motion, roads = load_vocabularies(folder)
    assert motion.path.shape == (3, 96, 6, 3)
    assert roads.curve_m.shape == (48, 11, 2)
    assert figures["real"]["cyclist"] == figures["roads_real"] == 0
    assert figures["error_m"]["cyclist"] is None
    assert not motion.real[AgentType.CYCLIST].any()


def test_scenes_that_cannot_be_tokenized_still_give_moves(tmp_path, drive):
    odd = dataclasses.replace(drive(now=3), scenario_id="ends between tokens")
    files = {"training.tfrecord-0": [odd], "validation.tfrecord-0": [odd]}
    _, figures = build(ingested(tmp_path / "ingest", files), tmp_path)
    assert figures["real"]["vehicle"] >= 1
    assert figures["error_m"]["vehicle"] is None


def test_samples_of_a_file_are_bounded(tmp_path, traffic):
    settings = dataclasses.replace(SETTINGS, samples_per_shard=10)
    inputs = ingested(tmp_path / "ingest", {"training.tfrecord-0": traffic(40)})
    (unit,) = vocabulary.plan(inputs, settings)
    report = vocabulary.work(unit, tmp_path, settings, no_progress)
    assert report["learn"] + report["held-out"] == 40
    segments = vocabulary._read(
        tmp_path / "learn" / "segments.zarr",
        vocabulary.MotionSamples,
        vocabulary.SEGMENTS_SCHEMA,
    )
    assert (np.bincount(segments[0].agent_type) <= 10).all()
    paths = vocabulary._read(
        tmp_path / "learn" / "paths.zarr", vocabulary.KeyedPaths, vocabulary.PATHS_SCHEMA
    )
    assert len(paths) == 8


def test_a_missing_vocabulary_is_an_error_that_says_so(tmp_path):
    with pytest.raises((StoreError, FileNotFoundError)):
        load_vocabularies(tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs real records in ../shared/data/womd")
def test_vocabularies_from_a_few_real_files_write_held_out_scenes_closely(tmp_path):
    files = [*sorted(SHARED.glob("training*"))[:2], *sorted(SHARED.glob("validation*"))]
    done = []
    for file in files:
        target = tmp_path / "ingest" / file.name
        unit = Unit(file.name, {"source": file_identity(file)}, {"url": str(file)})
        report = ingest.work(
            unit, target, IngestSettings(max_scenes_per_file=10), no_progress
        )
        done.append(FinishedUnit(file.name, file.name, target, report))
    folder, figures = build(Ingested(done), tmp_path, VocabSettings(samples_per_shard=4096))
    motion, _ = load_vocabularies(folder)
    report = json.loads((folder / "report.json").read_text())

    assert motion.num_motion_tokens == 2048
    for kind, most_m in (("vehicle", 0.07), ("pedestrian", 0.05), ("cyclist", 0.05)):
        row = report["motion"][kind]
        assert row["beyond_limits"] == 0
        assert row["nearest_gap_m"]["min"] >= 0.05
        assert row["held_out_error_m"] is None or row["held_out_error_m"]["mean"] <= most_m
    assert report["roads"]["held_out_error_m"]["mean"] <= 0.05
    assert figures["real"]["vehicle"] > 500


def test_the_error_of_tokens_is_told_source_by_source(tmp_path, traffic):
    files = {
        "training.tfrecord-0": traffic(4),
        "training.argoverse2-00000-of-00001": traffic(3, first=4),
        "validation.tfrecord-0": traffic(2, first=7),
    }
    target, _ = build(ingested(tmp_path / "ingest", files), tmp_path)

    report = json.loads((target / "report.json").read_text())
    assert list(report["sources"]) == ["argoverse2", "tfrecord"]
    own, other = report["sources"].values()
    assert (own["scenes"], own["held_out"]) == (3, False)  # None of them was held out.
    assert (other["scenes"], other["held_out"]) == (2, True)
    for found in (own, other):
        assert set(found["tokens"]) == {"vehicle", "pedestrian", "cyclist", "map"}
        for error in found["tokens"].values():
            assert 0 <= error["mean"] <= error["p95"] < 1
    whole = report["motion"]["vehicle"]["held_out_error_m"]
    assert other["tokens"]["vehicle"]["mean"] == whole["mean"]
    assert other["tokens"]["map"]["mean"] == report["roads"]["held_out_error_m"]["mean"]
    page = (target / "report.html").read_text()
    assert "Token error by source" in page
    assert "2 held out" in page
