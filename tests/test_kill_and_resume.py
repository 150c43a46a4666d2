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
    words = ("--records", "builtin", "--profile", "demo")
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
    root = trial.folder / "two-workers"
    trial.make(script.STAGES[-1], root, "--dask", "local:2")

    script.compare(script.digest(root), script.digest(quiet), "--dask local:2")
