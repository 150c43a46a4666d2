"""The short form of ``kill_and_resume.py``: three kills per stage, two workers."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

script = SimpleNamespace(
    **runpy.run_path(str(Path(__file__).with_name("kill_and_resume.py")))
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    words = (
        "--records",
        "builtin",
        "--profile",
        "smoke",
        "-s",
        "ingest.max_scenes_per_file=0",
    )
    return script.Trial(words, tmp_path_factory.mktemp("trial"))


@pytest.fixture(scope="module")
def quiet(trial):
    """A root that was made without any trouble."""
    trial.make(script.STAGES[-1], trial.folder / "quiet")
    return trial.folder / "quiet"


@pytest.mark.parametrize("stage", script.STAGES)
def test_a_killed_stage_comes_out_byte_for_byte_when_run_again(trial, quiet, stage):
    script.kill_stage(trial, stage, quiet, kills=3, seed=0)


def test_two_workers_write_the_bytes_of_one_process(trial, quiet):
    script.compare_workers(trial, "local:2", quiet, script.STAGES)


PLAYED = (
    "ingest.max_scenes_per_file=6",
    "train.validation_scenes=2",
    "calibrate.method=simulate",
    "calibrate.max_scenes=2",
    "calibrate.scenes_per_unit=1",
    "rollout.max_scenes=6",
    "rollout.count=2",
)
EIGHT = 8


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A job of all stages on built-in scenes, in a minute, and its quiet root."""
    settings = [word for given in PLAYED for word in ("-s", given)]
    words = ("--records", "builtin", "--profile", "tiny", *settings)
    trial = script.Trial(words, tmp_path_factory.mktemp("played"))
    trial.make(script.ALL_STAGES[-1], trial.folder / "quiet")
    return trial, trial.folder / "quiet"


@pytest.mark.parametrize("victim", script.VICTIMS)
def test_rollouts_come_out_byte_for_byte_whatever_is_killed(played, victim):
    trial, quiet = played
    script.kill_stage(trial, "rollout", quiet, kills=1, seed=1, victim=victim)


@pytest.mark.parametrize("stage", script.ALL_STAGES[len(script.STAGES) :])
def test_a_killed_later_stage_comes_out_byte_for_byte_when_run_again(played, stage):
    trial, quiet = played
    script.kill_stage(trial, stage, quiet, kills=1, seed=0)


@pytest.mark.parametrize("stage", script.ALL_STAGES)
def test_a_worker_that_is_killed_at_any_stage_changes_no_byte(played, stage):
    trial, quiet = played
    script.kill_stage(trial, stage, quiet, kills=1, seed=2, victim="worker")


def test_a_report_by_eight_workers_that_are_killed_all_the_time_changes_no_byte(played):
    trial, quiet = played
    kills, _ = script.kill_throughout(trial, quiet, EIGHT, every_s=4.0, seed=0)
    assert kills


def test_two_workers_play_the_bytes_of_one_process(played):
    trial, quiet = played
    script.compare_workers(trial, "local:2", quiet, ("rollout",))
