"""The runs of a preset: which, in what order, with what in common, and when some fail."""

import os
import sys

import pytest

from infgen.errors import ConfigError
from pipeline.comparison.dry_run import plan_dry_run
from pipeline.comparison.execution import ExecutedRun, execute_arm_runs
from pipeline.comparison.records import find_records
from pipeline.comparison.runs import Comparison, arm_runs_of
from pipeline.comparison.write import write_comparison
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.events import Events
from pipeline.engine.layout import Root, read_json
from pipeline.engine.runner import RunOptions
from pipeline.settings.request import LAST, read_request
from pipeline.settings.stages_file import load_stages
from tests.pipeline.conftest import TOYS

STAGES = """\
version: 1
sources: texts/*.txt
stages:
  count: {module: toy_count, deps: [sources], params: [count]}
  train: {module: toy_train, deps: [count], params: [train]}
  rollout: {module: toy_rollout, deps: [train], params: [rollout]}
  score: {module: toy_score, deps: [rollout], params: [score]}
  report: {deps: [score]}
profiles:
  short: {count: {longest: 3}}
  steps: {train: {steps: 5}}
presets:
  mini:
    profile: steps
    seeds: 2
    rollout_sets: {long: {}, brief: {rollout: {mode: brief}}}
    arms:
      tuned: {starts_from: plain, train: {steps: 1}, rollout_sets: [brief]}
      plain: {rollout_sets: {long: {score: {presence_radius_m: 75}}, brief: {}}}
      other: {train: {steps: 7}, rollout_sets: [long]}
"""


@pytest.fixture
def shop(tmp_path, monkeypatch):
    """``shop(*words, arms, seeds, targets, ...)`` runs the preset; gives states by run."""
    monkeypatch.syspath_prepend(str(TOYS))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts/a.txt").write_text("one two three")
    (tmp_path / "stages.yaml").write_text(STAGES)
    yield _Shop(tmp_path)
    for name in ("toy_count", "toy_train", "toy_rollout", "toy_score"):
        sys.modules.pop(name, None)


class _Shop:
    def __init__(self, folder):
        self.folder, self.root = folder, Root(folder / "root")
        self.told: list = []

    def comparison(self, *words, targets=("report",), profile=None, records=()):
        path = self.folder / "stages.yaml"
        file = load_stages(path, {})
        preset = file.preset("mini")
        return Comparison(
            self.root, path, file, preset, profile, words, records, tuple(targets)
        )

    def arm_runs(self, *words, arms=(), seeds=1, **more):
        comparison = self.comparison(*words, **more)
        return arm_runs_of(comparison, comparison.preset.chosen(arms), seeds)

    def run(self, *words, arms=(), seeds=1, run_options=None, **more):
        comparison = self.comparison(*words, **more)
        arm_runs = arm_runs_of(comparison, comparison.preset.chosen(arms), seeds)
        events = Events(self.root, (self.told.append,))
        return execute_arm_runs(
            comparison, arm_runs, lambda plan: run_options or RunOptions(), events
        )

    def made(self, stage):
        return len(list(self.root.stage(stage).glob("*/manifest.json")))


def names(arm_runs):
    return [(arm_run.arm.name, arm_run.seed, arm_run.rollout_set) for arm_run in arm_runs]


def test_every_arm_is_run_with_every_seed_and_play_starts_first(shop):
    first = [("plain", 0, "long"), ("plain", 0, "brief"), ("tuned", 0, "brief")]
    first += [("other", 0, "long")]

    assert names(shop.arm_runs(seeds=2)) == first + [(a, 1, p) for a, _, p in first]


def test_a_start_that_is_not_compared_is_trained_only(shop):
    assert names(shop.arm_runs(arms=["tuned"])) == [("plain", 0, ""), ("tuned", 0, "brief")]
    (weights, _) = shop.run(arms=["tuned"])
    assert list(weights.keys) == ["count", "train"]


def test_an_early_target_is_made_once_an_arm(shop):
    ran = shop.run(targets=["train"])

    assert names(one.arm_run for one in ran) == [
        ("plain", 0, ""),
        ("tuned", 0, ""),
        ("other", 0, ""),
    ]
    assert {tuple(one.keys) for one in ran} == {("count", "train")}
    assert shop.made("rollout") == 0


def test_what_runs_have_in_common_is_made_once(shop):
    ran = shop.run(seeds=2)

    assert {one.state for one in ran} == {"made"}
    assert len({one.keys["count"] for one in ran}) == shop.made("count") == 1
    assert len({one.keys["train"] for one in ran}) == shop.made("train") == 6
    plain = [
        one.keys for one in ran if one.arm_run.arm.name == "plain" and not one.arm_run.seed
    ]
    assert plain[0]["train"] == plain[1]["train"]
    assert plain[0]["score"] != plain[1]["score"]


def test_an_arm_goes_on_from_the_weights_of_its_start_and_its_own_seed(shop):
    ran = {(one.arm_run.arm.name, one.arm_run.seed): one for one in shop.run(seeds=2)}

    def weights(arm, seed):
        (result,) = [r for r in ran[arm, seed].results if r.stage == "train"]
        return int(result.report["weights"])

    assert [weights("plain", seed) for seed in (0, 1)] == [5, 105]
    assert [weights("tuned", seed) for seed in (0, 1)] == [5 + 1, 105 + 101]


def test_a_play_has_the_settings_of_its_arm(shop):
    ran = {(one.arm_run.arm.name, one.arm_run.rollout_set): one for one in shop.run()}

    def told(*arm_run):
        return ran[arm_run].results[-1].report

    assert told("plain", "long") == {"mode": "long", "weights": 5, "radius_m": 75.0}
    assert told("plain", "brief") == {"mode": "brief", "weights": 5, "radius_m": 0.0}
    assert told("other", "long") == {"mode": "long", "weights": 7, "radius_m": 0.0}


def test_what_the_command_says_goes_over_all_arms(shop):
    ran = shop.run("train.steps=3", profile="short")

    assert [int(one.results[1].report["weights"]) for one in ran] == [3, 3, 6, 3]
    assert ran[0].results[0].report["words"] == 2


def test_a_second_call_finds_everything(shop):
    shop.run(seeds=2)

    again = shop.run(seeds=2)

    assert {one.state for one in again} == {"cached"}
    assert all(result.made == 0 for one in again for result in one.results)


def test_a_failing_arm_stops_neither_others_nor_their_seeds(shop):
    text = (shop.folder / "stages.yaml").read_text()
    text = text.replace("other: {train: {steps: 7}", "other: {train: {fail: true}")
    (shop.folder / "stages.yaml").write_text(text)

    states = {(one.arm_run.arm.name, one.arm_run.seed): one for one in shop.run(seeds=2)}

    assert states["other", 0].state == states["other", 1].state == "failed"
    assert states["other", 0].why == "train: weights: ValueError: told to fail"
    assert states["tuned", 0].is_whole
    assert states["tuned", 1].is_whole


def test_who_goes_on_from_failed_weights_is_left_out_and_says_so(shop):
    text = (shop.folder / "stages.yaml").read_text()
    text = text.replace("plain: {rollout_sets", "plain: {train: {fail: true}, rollout_sets")
    (shop.folder / "stages.yaml").write_text(text)

    ran = {(one.arm_run.arm.name, one.arm_run.rollout_set): one for one in shop.run()}

    assert ran["plain", "long"].state == "failed"
    assert ran["plain", "brief"].state == "skipped"  # The same weights are not tried twice.
    assert ran["plain", "brief"].why == ran["plain", "long"].why
    assert ran["tuned", "brief"].why == "there are no weights of plain"
    assert ran["other", "long"].state == "made"


def test_a_failing_play_leaves_the_others_of_its_arm(shop):
    text = (shop.folder / "stages.yaml").read_text()
    text = text.replace("long: {}, brief", "long: {rollout: {fail: true}}, brief")
    (shop.folder / "stages.yaml").write_text(text)

    states = [one.state for one in shop.run(arms=["plain"])]

    assert states == ["failed", "made"]
    assert [t["event"] for t in shop.told].count("arm-run-failed") == 1


def test_wrong_settings_are_told_with_their_line_before_anything_is_made(shop):
    text = (shop.folder / "stages.yaml").read_text()
    text = text.replace("other: {train: {steps: 7}", "other: {train: {stps: 7}")
    (shop.folder / "stages.yaml").write_text(text)
    comparison, wrong = shop.comparison(), shop.arm_runs(arms=["other"])[0]

    with pytest.raises(ConfigError, match=r"stages.yaml:20: train: no setting 'stps'"):
        comparison.sketch(wrong)


def test_seeds_are_not_set_by_hand(shop):
    with pytest.raises(ConfigError, match=r"-s train\.seed: the seeds of a preset are"):
        shop.run("train.seed=3")


def test_what_is_made_again_is_made_once(shop):
    shop.run()

    ran = shop.run(run_options=RunOptions(force=frozenset({"train"})), arms=["plain"])

    states = [[result.state for result in one.results] for one in ran]
    assert states == [
        ["cached", "made", "made", "made"],
        ["cached", "cached"] + ["made"] * 2,
    ]


def test_a_run_is_remembered_as_if_it_had_been_asked_for_alone(shop):
    ran = shop.run(arms=["plain"])

    kept = read_request(shop.root, "preset.mini.plain.0.long")
    assert kept["keys"] == ran[0].keys
    last = read_json(shop.root.refs / LAST)
    assert last["profile"] == "steps"
    assert last["overrides"] == ["rollout.mode=brief", "rollout.seed=0", "train.seed=0"]


def test_a_dry_run_tells_what_each_run_adds(shop):
    comparison = shop.comparison()
    arm_runs = shop.arm_runs()

    before = {each.run: each for each in plan_dry_run(comparison, arm_runs)}
    assert before["plain, seed 0, long"].makes == ("count", "train", "rollout", "score")
    assert before["plain, seed 0, brief"].makes == ("rollout", "score")
    assert before["tuned, seed 0, brief"].makes == ("train", "rollout", "score")
    assert before["tuned, seed 0, brief"].note == "after plain"
    assert not shop.root.store.exists()
    shop.run(arms=["plain"])
    after = {each.run: each for each in plan_dry_run(comparison, arm_runs)}
    assert after["plain, seed 0, long"].makes == ()
    assert after["tuned, seed 0, brief"].makes == ("train", "rollout", "score")
    assert after["tuned, seed 0, brief"].note == ""


def test_records_of_ones_own_must_be_named(shop):
    (shop.folder / "texts/a.txt").unlink()

    with pytest.raises(ConfigError, match="preset mini reads records of your own; name"):
        find_records(shop.comparison(), shop.told.append)
    named = shop.comparison(records=("elsewhere/*",))
    assert find_records(named, shop.told.append) == named


def test_towns_are_written_once_where_no_records_are_named(shop, monkeypatch):
    text = (shop.folder / "stages.yaml").read_text()
    towns = "    towns: {training: {scenes: 3, seconds: 2.1, scenes_per_file: 2}}\n"
    (shop.folder / "stages.yaml").write_text(text.replace("    seeds: 2\n", towns))
    asked = []
    monkeypatch.setattr(
        "pipeline.comparison.records.write_towns", lambda order, tell: asked.append(order)
    )
    before = plan_dry_run(shop.comparison(), shop.arm_runs(arms=["plain"]))
    assert before[0].note == "after 2 files of towns are written"

    found = find_records(shop.comparison(), shop.told.append)

    out = shop.root.path / "towns"
    assert found.records == (str(out / "training.tfrecord-*-of-00002.gz"),)
    assert (asked[0].out, asked[0].scenes, asked[0].split) == (out, 3, "training")


def test_a_comparison_that_was_half_removed_is_written_anew(shop):
    ran = [ExecutedRun(arm_run, "skipped", "nobody made it") for arm_run in shop.arm_runs()]
    shown = write_comparison(shop.comparison(), ran, again=False)
    page = (shown / "comparison.html").read_bytes()
    (shown / MANIFEST).unlink()
    (shown / "comparison.html").unlink()

    for again in (False, True):
        assert write_comparison(shop.comparison(), ran, again=again) == shown
        assert (shown / MANIFEST).is_file()
        assert (shown / "comparison.html").read_bytes() == page
