import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from infgen.config import ReferenceSettings, ScoreSettings, TokenSettings
from infgen.errors import ConfigError
from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS
from infgen.rollout.rollout import NEVER, Rollout
from infgen.scene import Scene
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import reference
from pipeline.stages.score import stage as score
from pipeline.storage.rollouts import ROLLOUTS_SCHEMA
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import write_records

STEPS = 91
SETTINGS = {
    "reference": ReferenceSettings(),
    "score": ScoreSettings(bootstrap_resamples=50),
}
REFERENCE = {"tokenize": TokenSettings(), "reference": ReferenceSettings()}
SOURCE = "validation.tfrecord-00000-of-00001"


class Inputs:
    """Finished units of the stages that ``score`` and ``reference`` read."""

    sources = ()

    def __init__(self, ingested, played):
        self._units = {"ingest": ingested, "rollout": played}
        self.reference = None

    def units(self, stage):
        return self._units[stage]

    def folder(self, stage):
        assert stage == "reference"
        return self.reference

    def key(self, stage):
        raise AssertionError("a key changes more often than what the stage reads")

    def content(self, stage, *names):
        assert all((self.folder(stage) / name).exists() for name in names)
        return f"content of {stage}"

    def refer(self, folder, settings=REFERENCE):
        """Make the reference, and read it from now on."""
        self._units["reference"] = do_units(reference, folder, self, settings)
        self.reference = folder / "out"
        return finish(reference, folder, self, self.units("reference"), settings)


def do_units(stage, folder: Path, inputs: Inputs, settings) -> list[FinishedUnit]:
    """Do all units of a stage."""
    done = []
    for unit in stage.plan(inputs, settings):
        target = folder / unit.name
        told = json.loads(json.dumps(stage.work(unit, target, settings, silent)))
        done.append(FinishedUnit(unit.name, unit.name, target, told))
    return done


def finish(stage, folder: Path, inputs: Inputs, done, settings):
    return stage.finish(inputs, done, folder / "out", settings, silent)


def as_rollout(scene: Scene, index: int = 0, shift_m: float = 0.0, steps=None) -> Rollout:
    """The log as a rollout, moved aside after now; who is not there now is not in it."""
    tracks = scene.tracks
    rows = np.flatnonzero(tracks.valid[:, scene.now])
    xyz_m = tracks.xyz_m[rows].copy()
    xyz_m[:, scene.now + 1 :, 1] += shift_m
    valid = tracks.valid[rows].copy()
    valid[:, scene.now + 1 :] = True
    cut = slice(0, steps)
    return Rollout(
        scenario_id=scene.scenario_id,
        index=index,
        seed=index,
        weights="none",
        origin_xyz_m=scene.origin_xyz_m,
        now=scene.now,
        ego=int(np.flatnonzero(rows == scene.ego)[0]),
        id=tracks.id[rows],
        agent_type=tracks.agent_type[rows],
        size_lwh_m=tracks.size_lwh_m[rows, scene.now],
        xyz_m=xyz_m[:, cut],
        heading_rad=tracks.heading_rad[rows][:, cut],
        valid=valid[:, cut],
        logged=np.ones(len(rows), dtype=bool),
        entry_step=np.zeros(len(rows), dtype=np.int16),
        exit_step=np.full(len(rows), NEVER, dtype=np.int16),
    )


def ingested(folder: Path, scenes, name=SOURCE) -> FinishedUnit:
    folder.mkdir(parents=True)
    write_records(folder / "scenes-000.zarr", scenes, Scene, SCENES_SCHEMA, compress=True)
    return FinishedUnit(name, f"key of {name}", folder, {"scenes": len(scenes)})


def played(folder: Path, rollouts, name=f"{SOURCE}-00000") -> FinishedUnit:
    folder.mkdir(parents=True)
    path = folder / "rollouts-000.zarr"
    write_records(path, rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True)
    index = pl.DataFrame({"scenario_id": [one.scenario_id for one in rollouts]})
    index.write_parquet(folder / "index.parquet")
    return FinishedUnit(name, f"key of {name}", folder, {"rollouts": len(rollouts)})


def silent(done, total, note=""):
    pass


def run(folder: Path, inputs: Inputs, settings=SETTINGS):
    """Do both stages; returns the summary, the scores and the report."""
    inputs.refer(folder / "reference")
    done = do_units(score, folder, inputs, settings)
    report = finish(score, folder, inputs, done, settings)
    summary = json.loads((folder / "out" / "summary.json").read_text())
    return summary, pl.read_parquet(folder / "out" / "scores.parquet"), report


@pytest.fixture
def scenes(crossing, parked):
    return [
        replace(crossing(), scenario_id="crossing"),
        replace(parked(), scenario_id="parked"),
        replace(crossing(speed_mps=6.0), scenario_id="slow"),
    ]


@pytest.fixture
def inputs(tmp_path, scenes):
    rollouts = [as_rollout(scene, at, 0.5 * at) for scene in scenes for at in range(2)]
    return Inputs(
        [ingested(tmp_path / "logs", scenes)], [played(tmp_path / "played", rollouts)]
    )


@pytest.fixture
def result(tmp_path, inputs):
    return run(tmp_path / "score", inputs)


def test_a_unit_is_made_again_only_if_its_rollouts_or_logs_or_the_reference_change(
    tmp_path, inputs
):
    inputs.refer(tmp_path / "reference")
    logs, unit = score.plan(inputs, SETTINGS)

    assert logs.name == SOURCE
    assert logs.inputs == {"logs": SOURCE, "reference": "content of reference"}
    assert unit.name == f"{SOURCE}-00000"
    assert unit.inputs == {
        "rollouts": f"key of {SOURCE}-00000",
        "scenes": f"key of {SOURCE}",
        "logs": SOURCE,
        "reference": "content of reference",
    }


def test_rollouts_of_another_split_than_the_reference_are_a_wrong_setting(tmp_path, scenes):
    other = played(tmp_path / "p", [as_rollout(scenes[0])], "testing.tfrecord-0-of-1-00000")
    inputs = Inputs([ingested(tmp_path / "l", scenes)], [other])
    inputs.refer(tmp_path / "reference")

    with pytest.raises(ConfigError, match=r"set reference\.split=testing"):
        score.plan(inputs, SETTINGS)


def test_a_metric_that_does_not_exist_is_refused_before_anything_is_scored(inputs):
    settings = {**SETTINGS, "score": ScoreSettings(wosac_version="wosac-2099")}

    with pytest.raises(ConfigError, match="'wosac-2099'; expected one of wosac-2023"):
        score.plan(inputs, settings)


def test_how_rollouts_are_cut_into_units_changes_no_number(tmp_path, scenes, result):
    rollouts = [as_rollout(scene, at, 0.5 * at) for scene in scenes for at in range(2)]
    units = [
        played(tmp_path / f"p{at}", rollouts[at : at + 2], f"{SOURCE}-0000{at}")
        for at in (0, 2, 4)
    ]
    inputs = Inputs([ingested(tmp_path / "l", scenes)], units)

    summary, scores, report = run(tmp_path / "cut", inputs)

    assert summary == result[0]
    assert report == result[2]
    keys = ["metric", "scenario_id", "rollout"]
    assert scores.sort(keys).equals(result[1].sort(keys))
    one, cut = (
        pl.read_parquet(tmp_path / name / "out" / "curves.parquet")
        for name in ("score", "cut")
    )
    assert one.drop("value").equals(cut.drop("value"))
    np.testing.assert_allclose(one["value"], cut["value"], rtol=1e-12)


def test_the_logs_own_scores_come_first(result):
    _, scores, _ = result
    own = scores.filter(pl.col("metric") == "log/corrected/composite")

    assert scores["metric"].str.starts_with("log/").head(len(own)).all()
    assert own["scenario_id"].to_list() == ["crossing", "parked", "slow"]
    assert own["rollout"].is_null().all()
    assert own["value"].is_between(0, 1).all()


def test_every_rollout_gets_a_row_for_every_number_that_it_has(result):
    _, scores, _ = result
    rows = scores.filter(pl.col("metric") == "corrected/composite").sort(
        "scenario_id", "rollout"
    )

    assert rows["scenario_id"].to_list() == ["crossing"] * 2 + ["parked"] * 2 + ["slow"] * 2
    assert rows["rollout"].to_list() == [0, 1] * 3
    assert rows["value"].is_between(0, 1).all()


def test_the_summary_holds_every_feature_of_both_protocols_with_its_interval(result):
    summary, _, _ = result

    for protocol in PROTOCOLS:
        found = summary["protocols"][protocol.name]
        for feature in FEATURES:
            entry = found["scores"][feature.name]
            if entry["mean"] is not None:
                assert entry["low"] <= entry["mean"] <= entry["high"]
            assert feature.name in found["divergence"]


def test_the_mean_over_scenes_is_that_of_the_table(result):
    summary, scores, _ = result
    speed = scores.filter(
        (pl.col("metric") == "paper/linear_speed") & pl.col("rollout").is_not_null()
    )
    per_scene = speed.group_by("scenario_id").agg(pl.col("value").mean())

    found = summary["protocols"]["paper"]["scores"]["linear_speed"]["mean"]
    assert found == pytest.approx(per_scene["value"].mean())


def test_the_log_scores_higher_than_the_same_log_pushed_off_the_road(
    result, tmp_path, scenes
):
    off = [as_rollout(scene, shift_m=-8.0) for scene in scenes]
    inputs = Inputs([ingested(tmp_path / "l", scenes)], [played(tmp_path / "p", off)])
    pushed, _, _ = run(tmp_path / "pushed", inputs)

    on_road = result[0]["protocols"]["corrected"]["scores"]["offroad_indication"]["mean"]
    off_road = pushed["protocols"]["corrected"]["scores"]["offroad_indication"]["mean"]
    assert off_road < on_road


def test_the_official_metric_is_scored_where_all_agents_stay(result):
    summary, scores, report = result

    assert summary["wosac"]["version"] == "wosac-2025"
    assert summary["wosac"]["scenes"] == 3
    assert 0 < report["wosac_metametric"] <= 1
    assert (scores["metric"] == "wosac-2025/metametric").sum() == 3


def test_what_a_source_does_not_record_is_null_and_counted(tmp_path, scenes):
    dark = [scenes[0], *(replace(scene, lights_recorded=False) for scene in scenes[1:])]
    inputs = Inputs(
        [ingested(tmp_path / "l", dark)],
        [played(tmp_path / "p", [as_rollout(scene) for scene in dark])],
    )

    summary, scores, report = run(tmp_path / "score", inputs)

    told = summary["wosac"]
    name = "traffic_light_violation_likelihood"
    assert told["not_measured"] == {name: 2, "simulated_traffic_light_violation_rate": 2}
    assert told["scores"][name]["mean"] is not None
    assert report["wosac_metametric"] is not None
    measured = scores.filter(pl.col("metric") == f"wosac-2025/{name}")
    assert measured["scenario_id"].to_list() == ["crossing"]

    only = Inputs(
        [ingested(tmp_path / "l2", dark[1:])],
        [played(tmp_path / "p2", [as_rollout(scene) for scene in dark[1:]])],
    )
    summary, _, _ = run(tmp_path / "score2", only)
    assert summary["wosac"]["scores"][name]["mean"] is None


def test_rollouts_that_lose_an_agent_are_skipped_officially_with_the_reason(
    tmp_path, scenes
):
    lost = as_rollout(scenes[0])
    valid = lost.valid.copy()
    valid[1, 40:] = False
    inputs = Inputs(
        [ingested(tmp_path / "l", scenes)],
        [played(tmp_path / "p", [replace(lost, valid=valid)])],
    )

    summary, _, report = run(tmp_path / "score", inputs)

    assert summary["wosac"]["skipped"]["first"] == [
        "scene crossing: 1 agents missing of 3 observed now: 101"
    ]
    assert report["wosac_metametric"] is None


def test_a_scene_without_a_log_is_named(tmp_path, scenes):
    stray = replace(as_rollout(scenes[0]), scenario_id="stray")
    inputs = Inputs(
        [ingested(tmp_path / "l", scenes)],
        [played(tmp_path / "p", [as_rollout(scenes[1]), stray])],
    )

    summary, _, report = run(tmp_path / "score", inputs)

    assert report["missing"] == ["stray"]
    assert summary["missing_scenes"] == {"count": 1, "first": ["stray"]}
    assert report["scenes"] == 1


def test_a_log_too_short_for_a_window_is_skipped_by_name(tmp_path, scenes, crossing):
    short = replace(crossing(steps=50), scenario_id="short")
    inputs = Inputs(
        [ingested(tmp_path / "l", [*scenes, short])],
        [played(tmp_path / "p", [as_rollout(scenes[0])])],
    )

    summary, _, _ = run(tmp_path / "score", inputs)

    assert summary["skipped_logs"]["first"] == ["short: 50 steps hold no window of 8 s"]
    assert summary["logs"] == 3


def test_rollouts_shorter_than_a_window_have_no_scores_but_do_not_stop_the_rest(
    tmp_path, scenes
):
    inputs = Inputs(
        [ingested(tmp_path / "l", scenes)],
        [played(tmp_path / "p", [as_rollout(scenes[0], steps=41)])],
    )

    summary, _, _ = run(tmp_path / "score", inputs)

    assert summary["protocols"]["paper"]["scores"]["linear_speed"]["mean"] is None
    assert "expected 80" in summary["wosac"]["skipped"]["first"][0]


def test_curves_have_one_value_per_window(result, tmp_path):
    curves = pl.read_parquet(tmp_path / "score" / "out" / "curves.parquet")
    ace = curves.filter(pl.col("metric") == "ace/own_near")

    assert ace["window"].to_list() == [0]
    assert ace["rollouts"].to_list() == [6]


def test_the_same_units_give_the_same_bytes(tmp_path, inputs):
    run(tmp_path / "one", inputs)
    run(tmp_path / "two", inputs)

    for name in ("scores.parquet", "curves.parquet", "summary.json"):
        one, two = (tmp_path / run / "out" / name for run in ("one", "two"))
        assert one.read_bytes() == two.read_bytes(), name


def test_without_rollouts_there_is_an_empty_table(tmp_path, scenes):
    inputs = Inputs([ingested(tmp_path / "l", scenes)], [])
    summary, scores, report = run(tmp_path / "score", inputs)

    assert scores["metric"].str.starts_with("log/").all()
    assert report["scenes"] == summary["scenes"] == 0
    assert report["composite_paper"] is report["composite_corrected"] is None


def test_protocol_proper_scores_each_scene_and_the_split(result, tmp_path):
    summary, scores, _ = result
    proper = summary["proper"]

    assert (proper["scenes"], proper["windows"], proper["window_s"]) == (3, 4, 2.0)
    energy = scores.filter(pl.col("metric") == "proper/energy")
    assert energy["scenario_id"].to_list() == ["crossing", "parked", "slow"]
    assert proper["numbers"]["energy"]["mean"] == pytest.approx(energy["value"].mean())
    likelihood = proper["numbers"]["likelihood/composite"]
    assert 0 < likelihood["low"] <= likelihood["mean"] <= likelihood["high"] < 1
    assert sum(proper["ranks"]["entries"]) == pytest.approx(1)
    curves = pl.read_parquet(tmp_path / "score" / "out" / "proper_curves.parquet")
    model = curves.filter(pl.col("metric") == "model/energy")
    assert model["window"].to_list() == [0, 1, 2, 3]
    assert model["scenes"].to_list() == [3] * 4


def test_what_no_scene_shows_is_not_measured(result):
    numbers = result[0]["proper"]["numbers"]

    assert numbers["w1/setting_off_delay"]["mean"] is None
    assert numbers["skill_persistence/pedestrians"]["mean"] is not None


def test_protocol_proper_is_a_setting(tmp_path, inputs):
    settings = {**SETTINGS, "score": ScoreSettings(proper=False)}

    summary, scores, _ = run(tmp_path / "score", inputs, settings)

    assert summary["proper"]["scenes"] == 0
    assert summary["proper"]["numbers"]["energy"]["mean"] is None
    assert not scores["metric"].str.starts_with("proper/").any()


def test_one_rollout_has_likelihoods_but_no_fair_score(tmp_path, scenes):
    inputs = Inputs(
        [ingested(tmp_path / "l", scenes)],
        [played(tmp_path / "p", [as_rollout(scene) for scene in scenes])],
    )

    numbers = run(tmp_path / "score", inputs)[0]["proper"]["numbers"]

    assert numbers["energy"]["mean"] is numbers["spread_skill/vehicles"]["mean"] is None
    assert numbers["likelihood/map"]["mean"] is not None


def test_the_radius_setting_makes_agents_enter_and_leave(tmp_path, scenes):
    # The ego drives away from the parked cars: with a circle of 20 m they are left behind.
    leaving = replace(scenes[0], scenario_id="crossing")
    settings = {
        **SETTINGS,
        "score": ScoreSettings(bootstrap_resamples=0, presence_radius_m=20.0),
    }
    inputs = Inputs(
        [ingested(tmp_path / "l", scenes)], [played(tmp_path / "p", [as_rollout(leaving)])]
    )

    _, scores, _ = run(tmp_path / "score", inputs, settings)

    rate = dict(scores.filter(pl.col("rollout") == 0).select("metric", "value").iter_rows())
    assert rate["rate/entries"] > 0
