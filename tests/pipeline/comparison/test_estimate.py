"""What a comparison will take: counted by hand for WOMD's size, and nothing is run."""

from pathlib import Path

import pytest

from infgen.errors import ConfigError
from pipeline.commands.estimates import hours_of, num_workers
from pipeline.comparison.costs import Cost
from pipeline.comparison.estimate import Budget, Estimated, clock_hours, estimate, fit
from pipeline.comparison.probe import kind
from pipeline.comparison.runs import Comparison, arm_runs_of
from pipeline.comparison.workload import (
    CHECKPOINTS,
    SCORED_LOGS,
    VALIDATION,
    Split,
    workload,
)
from pipeline.engine.layout import Root
from pipeline.engine.plan import PlanError
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages

WOMD = {"training": Split(1000, 487_000, 2), "validation": Split(150, 44_000, 2)}
HOUR = 3600.0


def comparison(tmp_path, *overrides, preset="paper"):
    file = load_stages(DEFAULT_FILE, {})
    return Comparison(
        root=Root(tmp_path),
        path=DEFAULT_FILE,
        file=file,
        preset=file.preset(preset),
        profile=None,
        overrides=overrides,
        records=(),
        targets=("score",),
    )


def work_of(asked, splits=WOMD):
    arms = list(asked.preset.arms.values())
    return workload(asked, arm_runs_of(asked, arms, asked.preset.seeds), splits)


def amounts(found, stage):
    return {each.arm_run.words: each.amount for each in found if each.stage == stage}


def test_the_papers_experiment_on_womd_is_counted(tmp_path):
    found = work_of(comparison(tmp_path))

    steps = amounts(found, "train")
    assert steps["infgen, seed 0, long"] == 122_000 * 128
    assert steps["catk, seed 0, long"] == 12_200 * 128
    assert len(steps) == 7
    rollouts = amounts(found, "rollout")
    assert rollouts["infgen, seed 0, wosac"] == 44_000 * 32
    assert rollouts["infgen, seed 0, long"] == 44_000
    assert rollouts["no-heading-token, seed 0, long"] == 2_204
    assert len(rollouts) == 3 * 3 + 4
    assert amounts(found, "score") == rollouts


def test_a_stage_that_runs_share_is_counted_once(tmp_path):
    found = work_of(comparison(tmp_path))

    for stage, scenes, units in (
        ("ingest", 531_000, 1150),
        ("tokenize", 531_000, 1150),
        ("reference", 44_000, 150),
    ):
        (only,) = [each for each in found if each.stage == stage]
        assert (only.amount, only.units) == (scenes, units)


def test_logs_are_scored_once_for_all_runs_that_score_alike(tmp_path):
    found = work_of(comparison(tmp_path))

    # All but the long rollouts of SMART and CatK, whose agents are present within 75 m.
    logs = [each for each in found if each.stage == SCORED_LOGS]
    assert [(each.amount, each.units) for each in logs] == [(44_000, 150)] * 2


def test_limits_of_scenes_reach_all_that_follows(tmp_path):
    words = ("ingest.max_scenes_per_file=10", "rollout.max_scenes=100")
    found = work_of(comparison(tmp_path, *words))

    assert set(amounts(found, "ingest").values()) == {11_500}
    assert set(amounts(found, "rollout").values()) == {100, 3_200}


def test_rollouts_of_calibration_are_counted(tmp_path):
    found = work_of(
        comparison(tmp_path, "calibrate.method=simulate", preset="towns-benchmark"),
        {**WOMD, "tuning": WOMD["validation"]},
    )

    assert amounts(found, "calibrate")["infgen, seed 0, long"] % 48 == 0


def test_validations_and_checkpoints_of_training_are_counted(tmp_path):
    words = ("train.steps=1000", "train.checkpoint_every_steps=400")
    often = "train.validate_every_steps=250"

    found = work_of(comparison(tmp_path, *words, often))

    # After 400, 800 and all 1,000 steps; 4 times on the way and once in the end.
    assert set(amounts(found, CHECKPOINTS).values()) == {3}
    assert set(amounts(found, VALIDATION).values()) == {5 * 64}


def test_few_held_out_scenes_are_all_validated(tmp_path):
    found = work_of(comparison(tmp_path), WOMD | {"validation": Split(2, 20, 2)})

    assert set(amounts(found, VALIDATION).values()) == {20}


def test_a_split_that_no_record_is_of_is_named(tmp_path):
    with pytest.raises(
        PlanError, match=r"no file of split 'validation'.*there is training"
    ):
        work_of(comparison(tmp_path), {"training": WOMD["training"]})


def test_hours_bytes_and_files_follow_from_costs(tmp_path):
    (work,) = [
        each
        for each in work_of(comparison(tmp_path))
        if (each.stage, each.arm_run.words) == ("rollout", "smart, seed 0, wosac")
    ]
    # 8 s are 16 token steps: 2 + 16 * 0.5 seconds for each of 44,000 * 32 rollouts, and
    # a minute for each unit of 8 scenes.
    cost = Cost(seconds=2.0, per_unit=60.0, per_token=0.5, bytes_per_s=10.0, files=4.0)

    (found,) = estimate([work], {kind(work.arm_run, "rollout"): cost})

    assert found.hours == pytest.approx((44_000 * 32 * 10 + 5_500 * 60) / HOUR)
    assert found.bytes == 44_000 * 32 * 80
    assert found.files == 44_000 // 8 * 4


def one(stage, hours):
    return Estimated(stage, "", 1, "scenes", hours, 0.0, 1)


def test_units_run_on_all_workers_and_training_on_one():
    assert clock_hours([one("train", 3.0), one("rollout", 8.0)], workers=4) == 5.0


def test_a_budget_cuts_steps_and_scenes_alike_and_says_how_wide_intervals_get():
    found = [one("ingest", 5.0), one("train", 16.0), one("rollout", 4.0)]

    assert fit(found, 10.0, 1, steps=400, scenes=64) == Budget(0.25, 100, 16, 2.0)
    assert fit(found, 30.0, 1, steps=400, scenes=64) == Budget(1.0, 400, 64, 1.0)
    assert fit(found, 5.0, 1, steps=400, scenes=64) is None


@pytest.mark.parametrize(
    ("word", "hours"), [("24h", 24.0), ("90m", 1.5), ("2d", 48.0), ("1.5h", 1.5)]
)
def test_a_budget_is_a_time(word, hours):
    assert hours_of(word) == hours


@pytest.mark.parametrize("word", ["24", "h", "0h", "-1h", "24 h", "1w"])
def test_a_budget_that_is_no_time_is_refused(word):
    with pytest.raises(ConfigError, match="expected a time, as 24h, 90m or 2d"):
        hours_of(word)


@pytest.mark.parametrize(
    ("words", "workers"),
    [("none", 1), ("local:8", 8), ("gpu:0,2", 2), ("tcp://host:1", 1)],
)
def test_workers_are_counted_by_the_words_of_dask(words, workers):
    assert num_workers(words) == workers


def test_the_file_of_stages_at_the_top_is_the_packaged_one():
    own = Path(__file__).parents[3] / "stages.yaml"

    assert own.read_text() == DEFAULT_FILE.read_text()
