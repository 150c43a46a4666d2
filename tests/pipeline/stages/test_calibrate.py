import dataclasses
import json
import math
from pathlib import Path

import pytest

from infgen.config import CalibrateSettings, RolloutSettings, TokenSettings
from infgen.metrics.flow import FlowCounts
from infgen.scene import Scene
from pipeline.engine.plan import PlanError
from pipeline.engine.stage import FinishedUnit
from pipeline.stages import calibrate as stage
from pipeline.stages.calibration import Biases, read_found
from pipeline.stages.flow_response import DESIGN
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import write_records
from tests.conftest import straight_road
from tests.pipeline.finished import Finished

PLAYED = RolloutSettings(seconds=3.0, max_agents=16, count=7, seed=3)
SETTINGS = {
    "tokenize": TokenSettings(),
    "rollout": PLAYED,
    "calibrate": CalibrateSettings(method="simulate", max_scenes=3, scenes_per_unit=2),
}


def with_settings(section, **values):
    return {**SETTINGS, section: dataclasses.replace(SETTINGS[section], **values)}


NARROW = stage.normalize(SETTINGS)


@pytest.fixture
def inputs(tmp_path, weights, drive, crossing, parked):
    """Two files of training with two scenes each, of which one cannot be played."""
    files = {
        "training.tfrecord-0": [crossing(), drive(now=3)],
        "training.tfrecord-1": [crossing(speed_mps=5.0), parked()],
        "validation.tfrecord-0": [parked()],
    }
    done = []
    for name, scenes in files.items():
        folder = tmp_path / name
        folder.mkdir()
        path = folder / "scenes-000.zarr"
        write_records(path, scenes, Scene, SCENES_SCHEMA, compress=True)
        done.append(FinishedUnit(name, f"key of {name}", folder, {"scenes": len(scenes)}))
    return Finished(done, weights)


def log_of(weights, **bins):
    line = {"step": 1, "validation": bins}
    (weights / "train.jsonl").write_text(json.dumps(line) + "\n")


def told(point, played, logged=None):
    """A finished unit that played one point."""
    report = {
        "point": point,
        "scenes": 2,
        "played": dataclasses.asdict(played),
        "logged": dataclasses.asdict(logged or FlowCounts(1000, 1000, 9000, 1000)),
        "refused": ["scene 1: too short"],
        "device": "cpu",
    }
    return FinishedUnit(f"biases-{point}-000", "key", Path(), report)


def test_every_pair_of_biases_is_played_on_the_same_scenes(inputs):
    log_of(
        inputs.weights,
        add_bins={"count": [400], "predicted": [200], "happened": [300]},
    )
    units = stage.plan(inputs, NARROW)

    assert [unit.name for unit in units] == [
        f"biases-{point}-00{part}" for point in range(len(DESIGN)) for part in (0, 1)
    ]
    scenes = {json.dumps(unit.task["pieces"]) for unit in units}
    assert len(scenes) == 2
    first, second = units[:2]
    assert [piece["rows"] for piece in first.task["pieces"]] == [[0, 1]]
    assert [piece["rows"] for piece in second.task["pieces"]] == [[0]]
    assert set(first.inputs) == {"weights", "scenes/training.tfrecord-0"}
    assert set(second.inputs) == {"weights", "scenes/training.tfrecord-1"}
    adds = [unit.task["biases"]["add"] for unit in units[::2]]
    assert min(adds) == pytest.approx(math.log(3), abs=1e-4)
    assert max(adds) - min(adds) == pytest.approx(0.8, abs=1e-4)


def test_a_split_of_which_there_is_no_file_is_named_with_those_that_there_are(inputs):
    asked = stage.normalize(with_settings("calibrate", split="tuning"))

    with pytest.raises(PlanError, match=r"'tuning'.*there is: training, validation.*split"):
        stage.plan(inputs, asked)


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("calibrate", {"method": "odds"}),
        ("calibrate", {"method": "none"}),
        ("rollout", {"mode": "motion-only"}),
        ("rollout", {"mode": "wosac", "seconds": None}),
        ("rollout", {"remove": False}),
    ],
)
def test_nothing_is_played_where_it_is_not_asked_for_or_nobody_comes(
    inputs, section, values
):
    assert stage.plan(inputs, stage.normalize(with_settings(section, **values))) == []


def test_rollouts_that_differ_in_number_alone_share_a_calibration():
    for values in ({"count": 32}, {"seed": 9}, {"max_scenes": 5}, {"split": "testing"}):
        assert stage.normalize(with_settings("rollout", **values)) == NARROW
    for values in ({"motion_top_p": 0.5}, {"seconds": 9.0}, {"signals": "log"}):
        assert stage.normalize(with_settings("rollout", **values)) != NARROW
    plain = stage.normalize(with_settings("calibrate", method="odds"))
    other = {**with_settings("calibrate", method="odds"), "rollout": RolloutSettings()}
    assert stage.normalize(other) == plain


def test_a_unit_counts_rollouts_and_logs_and_names_what_cannot_be_played(
    inputs, tmp_path, quiet
):
    every = stage.normalize(with_settings("calibrate", max_scenes=0, scenes_per_unit=99))
    unit = stage.plan(inputs, every)[0]

    report = stage.work(unit, tmp_path / "out", every, quiet)

    assert report["scenes"] == 3
    assert report["played"]["tokens"] == 3 * 4
    assert report["logged"]["tokens"] == 3 * 2 * 4  # 8 s are two times 3 s, and some.
    assert report["logged"]["agents"] > 0
    assert len(report["refused"]) == 1
    assert "the history ends at step 0" in report["refused"][0]
    assert report["device"] == "cpu"
    assert report["run"]["device"].startswith("CPU, ")
    assert stage.work(unit, tmp_path / "again", every, quiet) == report


def test_a_rollout_counts_until_its_ego_leaves_the_map(inputs, drive, tmp_path, quiet):
    """The road ends 5 m behind the ego, which goes on by some 10 m a half second."""
    folder = tmp_path / "short"
    folder.mkdir()
    scene = drive(road_map=straight_road(10.0))
    path = folder / "scenes-000.zarr"
    write_records(path, [scene], Scene, SCENES_SCHEMA, compress=True)
    short = FinishedUnit("training.tfrecord-9", "key", folder, {"scenes": 1})
    every = stage.normalize(with_settings("calibrate", max_scenes=0, scenes_per_unit=99))
    unit = stage.plan(Finished([short], inputs.weights), every)[0]

    report = stage.work(unit, tmp_path / "out", every, quiet)

    assert report["played"]["tokens"] < 4
    assert report["logged"]["tokens"] == 2 * 4


@pytest.mark.slow
def test_a_higher_bias_lets_more_in(inputs, tmp_path, quiet):
    units = stage.plan(inputs, with_reach(4.0))
    least, most = (
        stage.work(unit, tmp_path / unit.name, with_reach(4.0), quiet)
        for unit in (units[0], units[-1])
    )

    assert most["played"]["came"] > least["played"]["came"]
    assert most["logged"] == least["logged"]


def with_reach(reach):
    return stage.normalize(
        with_settings(
            "calibrate",
            add_bias_range=reach,
            remove_bias_range=reach,
            max_scenes=0,
            scenes_per_unit=99,
        )
    )


def test_the_biases_with_which_plays_are_as_logs_are_left_for_rollouts(
    inputs, tmp_path, quiet
):
    played = [
        FlowCounts(
            round(1000 * math.exp(add - 0.5)), round(1000 * math.exp(leave)), 0, 1000
        )
        for add, leave in DESIGN
    ]
    units = [told(point, counts) for point, counts in enumerate(played)]

    report = stage.finish(inputs, units, tmp_path / "out", NARROW, quiet)

    assert read_found(tmp_path / "out") == Biases(add=0.4, leave=0.0)
    assert (report["method"], report["scenes"]) == ("simulate", 2)
    assert report["refused"] == ["scene 1: too short"]
    assert report["device"] == "cpu"
    assert report["came_expected"] == pytest.approx(1, abs=0.01)
    about = json.loads((tmp_path / "out" / "plays.json").read_text())
    assert about["logs"] == {
        "came_per_token": 1.0,
        "went_per_token": 1.0,
        "agents": 9.0,
    }
    assert [play["add"] for play in about["plays"]] == [0, 0.4, 0.4, 0.4, 0.8]


def test_where_too_few_come_to_tell_the_odds_decide_and_the_report_says_so(
    inputs, tmp_path, quiet
):
    units = [told(point, FlowCounts(0, 9, 0, 1000)) for point in range(len(DESIGN))]

    report = stage.finish(inputs, units, tmp_path / "out", NARROW, quiet)

    assert report["method"] == "odds"
    assert read_found(tmp_path / "out") == Biases()


@pytest.mark.parametrize(("method", "add"), [("odds", math.log(3)), ("none", 0.0)])
def test_without_plays_the_last_validation_decides_or_nothing(
    inputs, tmp_path, quiet, method, add
):
    log_of(
        inputs.weights,
        add_bins={"count": [400], "predicted": [200], "happened": [300]},
    )
    settings = stage.normalize(with_settings("calibrate", method=method))

    report = stage.finish(inputs, [], tmp_path / "out", settings, quiet)

    assert read_found(tmp_path / "out").add == pytest.approx(add, abs=1e-4)
    assert report["method"] == method
