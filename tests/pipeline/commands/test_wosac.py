"""``infgen wosac``: official scores of anyone's rollouts against anyone's records."""

import json
import tarfile
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from cli import main
from infgen.config import IngestSettings
from infgen.errors import ConfigError
from infgen.metrics.wosac import metric
from infgen.metrics.wosac.submission import Refused
from infgen.rollout.rollout import Rollout
from pipeline.commands.wosac import score_files
from pipeline.engine.stage import Unit
from pipeline.stages import ingest
from pipeline.storage.rollouts import ROLLOUTS_SCHEMA
from pipeline.storage.sources.fingerprints import fingerprint as file_identity
from pipeline.storage.zarr_store import write_records
from tests.metrics.golden import GOLDEN, golden_metrics, needs_goldens
from tests.metrics.wosac.test_submission import scenario, submission
from tests.pipeline.stages.score.test_stage import as_rollout

SCENES = 3
NAMED = {
    "wosac-2023": "challenge_2023_legacy",
    "wosac-2024": "challenge_2024",
    "wosac-2025": "challenge_2025_sim_agents",
}
GOLDEN_SET = "637f20cafde22ff8/test_submission"


def silent(done, total, note=""):
    pass


@pytest.fixture(scope="module")
def ingested(source, tmp_path_factory):
    target = tmp_path_factory.mktemp("ingested") / "unit"
    unit = Unit(source.name, {"source": file_identity(source)}, {"url": str(source)})
    ingest.work(unit, target, IngestSettings(), silent)
    return target


@pytest.fixture(scope="module")
def replays(scenes):
    """The log, twice, of each scene, last scene first."""
    return [as_rollout(scene, at, 0.2 * at) for scene in scenes[::-1] for at in range(2)]


def keep(folder, rollouts):
    """Write rollouts as a unit of our store."""
    folder.mkdir(parents=True)
    path = folder / "rollouts-000.zarr"
    write_records(path, rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True)
    index = pl.DataFrame({"scenario_id": [one.scenario_id for one in rollouts]})
    index.write_parquet(folder / "index.parquet")
    return folder


@pytest.fixture(scope="module")
def played(replays, tmp_path_factory):
    return keep(tmp_path_factory.mktemp("played") / "unit", replays)


@pytest.fixture
def infgen(capsys):
    def call(*words):
        with pytest.raises(SystemExit) as left:
            main(["wosac", *map(str, words)])
        out, err = capsys.readouterr()
        return left.value.code or 0, out, err

    return call


@pytest.fixture
def submit(tmp_path):
    def write(*scenarios):
        path = tmp_path / "submission.binproto"
        path.write_bytes(submission(*scenarios))
        return path

    return write


def test_our_rollouts_score_the_same_against_raw_and_ingested_logs(
    source, ingested, played, scenes, replays
):
    raw, kept = (
        score_files([str(name)], played, "wosac-2025") for name in (source, ingested)
    )

    assert list(raw.scores) == [scene.scenario_id for scene in scenes[::-1]]
    assert raw.scores == kept.scores
    for scene in scenes:
        own = [one for one in replays if one.scenario_id == scene.scenario_id]
        expected = metric.score(metric.from_scene(scene), metric.from_rollouts(own))
        assert raw.scores[scene.scenario_id] == expected


def test_a_stage_of_several_units_is_scored_through_its_manifest(
    tmp_path, source, replays, played
):
    units = {"a" * 16: replays[:2], "b" * 16: replays[2:]}
    for key, rollouts in units.items():
        keep(tmp_path / "units" / key, rollouts)
    stage = tmp_path / "c0ffee"
    stage.mkdir()
    about = {"files": {}, "units": [{"name": key, "key": key + "0" * 48} for key in units]}
    (stage / "manifest.json").write_text(json.dumps(about))
    (tmp_path / "latest").symlink_to(stage)

    found = score_files([str(source)], tmp_path / "latest", "wosac-2024")

    assert found.scores == score_files([str(source)], played, "wosac-2024").scores


def test_the_printed_table_holds_means_and_on_request_every_scene(
    infgen, source, played, scenes
):
    code, out, _ = infgen(source, played)
    assert code == 0
    assert f"mean over {SCENES} scenes" in out
    assert "time_to_collision_likelihood" in out
    assert scenes[0].scenario_id not in out

    _, out, _ = infgen(source, played, "--per-scene")
    assert all(scene.scenario_id in out for scene in scenes)


def test_json_holds_official_names_by_scene_and_their_mean(infgen, ingested, played):
    code, out, _ = infgen(ingested, played, "--json", "--metric", "wosac-2024")
    found = json.loads(out)

    assert code == 0
    assert found["metric"] == "wosac-2024"
    assert found["refused"] == []
    values = [one["metametric"] for one in found["scenarios"].values()]
    assert found["mean"]["metametric"] == pytest.approx(np.mean(values))
    assert {"linear_speed_likelihood", "simulated_collision_rate"} <= found["mean"].keys()


def test_progress_is_told_by_scenes(source, played):
    told = []
    score_files([str(source)], played, "wosac-2025", tell=told.append)

    assert [(e["done"], e["total"]) for e in told[2:]] == [(1, 3), (2, 3), (3, 3)]


def test_rollouts_that_lose_agents_are_refused_and_the_others_scored(
    tmp_path, infgen, source, replays
):
    valid = replays[0].valid.copy()
    valid[replays[0].ego, 40:] = False
    path = keep(tmp_path / "lost", [replace(replays[0], valid=valid), *replays[2:]])

    code, out, err = infgen(source, path)

    assert code == 1
    assert f"refused: {replays[0].scenario_id}: 1 agents missing of" in err
    assert f"mean over {SCENES - 1} scenes" in out


@pytest.mark.parametrize(
    ("change", "more", "reason"),
    [
        ({"ids": (1, 2)}, (), "agents missing of"),
        ({"steps": 91}, (), "trajectories have 91 steps; expected 80 (those after step 10"),
        ({"value": np.nan}, (), "holds a value that is not finite"),
        ({"rollouts": 31}, (), "has 31 rollouts; expected 32"),
        ({"name": "stray"}, (), "none of"),
        ({}, (99999,), "1 agents that the log does not show now: 99999"),
    ],
    ids=["missing", "steps", "not finite", "rollouts", "unknown", "strange"],
)
def test_a_wrong_submission_is_explained_in_one_line(
    infgen, source, scenes, submit, change, more, reason
):
    log = metric.from_scene(scenes[0])
    ids = [*log.id[log.sim_rows].tolist(), *more]
    wrong = {"name": scenes[0].scenario_id, "ids": ids, **change}

    code, _, err = infgen(source, submit(scenario(**wrong)))

    assert code == 1
    lines = [line for line in err.splitlines() if line.startswith("refused: ")]
    assert len(lines) == 1
    assert reason in lines[0]


def test_a_scene_given_twice_is_refused_the_second_time(source, scenes, submit):
    log = metric.from_scene(scenes[0])
    one = scenario(scenes[0].scenario_id, ids=log.id[log.sim_rows].tolist())

    found = score_files([str(source)], submit(one, one), "wosac-2025")

    assert len(found.scores) == 1
    assert found.refused == [Refused(scenes[0].scenario_id, "its rollouts are given twice")]


def test_a_folder_of_shards_is_one_submission(tmp_path, source, scenes):
    for at, scene in enumerate(scenes):
        log = metric.from_scene(scene)
        one = scenario(scene.scenario_id, rollouts=2, ids=log.id[log.sim_rows].tolist())
        (tmp_path / f"x.binproto-0000{at}").write_bytes(submission(one))

    found = score_files([str(source)], tmp_path, "wosac-2025", num_rollouts=0)

    assert list(found.scores) == [scene.scenario_id for scene in scenes]


@pytest.mark.parametrize(
    ("metric_name", "records", "rollouts", "reason"),
    [
        ("wosac-2026", "builtin", "played", "no metric 'wosac-2026'; did you mean"),
        ("wosac-2025", "nothing*", "played", "no records match"),
        ("wosac-2025", "builtin", "nothing", "no such file"),
        ("wosac-2025", "builtin", "empty", "no such files *binproto* or stage"),
        ("wosac-2025-scenario-gen", "builtin", "played", "name another metric"),
    ],
)
def test_wrong_words_are_exit_code_2(
    infgen, tmp_path, played, metric_name, records, rollouts, reason
):
    (tmp_path / "empty").mkdir()
    path = played if rollouts == "played" else tmp_path / rollouts

    code, _, err = infgen(records, path, "--metric", metric_name)

    assert code == 2
    assert reason in err


def test_a_store_without_rollouts_is_a_wrong_word(tmp_path, source):
    with pytest.raises(ConfigError, match="holds no rollouts"):
        score_files([str(source)], keep(tmp_path / "none", []), "wosac-2025")


@needs_goldens
@pytest.mark.parametrize("version", NAMED)
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "tar.gz"])
def test_the_official_test_submission_has_the_official_scores(
    infgen, tmp_path, version, packed
):
    folder = GOLDEN / GOLDEN_SET
    path = folder / "test_submission.binproto"
    if packed:
        with tarfile.open(tmp_path / "submission.tar.gz", "w:gz") as archive:
            archive.add(path, "submission.binproto-00000-of-00001")
        path = tmp_path / "submission.tar.gz"

    record = folder.parent / "scenario.tfrecord"
    code, out, _ = infgen(record, path, "--json", "--metric", version)

    official = golden_metrics(GOLDEN_SET)[NAMED[version]]
    (scores,) = json.loads(out)["scenarios"].values()
    assert code == 0
    for name, value in scores.items():
        if name in official:
            limit = 1e-5 if name == "metametric" else 5e-5
            assert value == pytest.approx(official[name], abs=limit), name
    assert len(scores.keys() & official.keys()) >= 16
