"""A disk that is full at the start, or in the midst, of every stage of the pipeline."""

import shutil

import pytest

from pipeline.engine.layout import Root
from pipeline.engine.manifest import verify
from tests.kill_and_resume import ALL_STAGES, Trial, compare, digest
from tests.pipeline.faults.conftest import BLOCK_BYTES

SETTINGS = (
    "ingest.max_scenes_per_file=2",
    "train.validation_scenes=2",
    "calibrate.method=simulate",
    "calibrate.max_scenes=1",
    "rollout.max_scenes=2",
    "rollout.seconds=4",
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A job of all stages, and the root of its run on a disk with enough space."""
    settings = [word for given in SETTINGS for word in ("-s", given)]
    words = ("--records", "builtin", "--profile", "tiny", *settings)
    trial = Trial(words, tmp_path_factory.mktemp("quiet"))
    trial.make(ALL_STAGES[-1], trial.folder / "root")
    return trial, trial.folder / "root"


def blocks(folder):
    """Blocks of 4 KiB that the files below a folder take; a folder takes none."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return sum(-(-path.stat().st_size // BLOCK_BYTES) for path in files)


@pytest.mark.parametrize("part", [0.0, 0.25, 0.6])
@pytest.mark.parametrize("stage", ALL_STAGES)
def test_a_disk_full_at_a_stage_stops_it_and_the_next_run_goes_on(
    quiet, small_disk, tmp_path, stage, part
):
    trial, root = quiet
    disk = small_disk(tmp_path / "disk", size="64m")
    there = disk.folder / "root"
    shutil.copytree(root, there, symlinks=True)
    needed = blocks(Root(there).stage(stage))
    shutil.rmtree(Root(there).stage(stage))
    disk.fill(int(part * needed))

    running = trial.start(stage, there)
    said = trial.end(running)

    assert running.returncode == 1, said
    assert f"{there}/" in said
    assert "cannot be written: No space left on device; it needs more than" in said
    left = [path.name for path in there.rglob("*.partial")]
    assert all(stage == "train" and len(name.split(".")) == 2 for name in left), left
    assert list(verify(Root(there), full=True)) == []
    disk.empty()
    trial.make(stage, there)
    compare(digest(there, (stage,)), digest(root, (stage,)), f"{stage}, {part} of its disk")
