"""A folder where the documentation's commands work as they stand, in seconds."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from infgen.sources.towns import builtin_records
from pipeline.engine.locks import locked
from pipeline.settings.stages_file import DEFAULT_FILE
from tests.docs.pages import REPOSITORY, Block, commands

FIRST = 'infgen run report --root work --records "$WOMD/*.tfrecord*" --profile small'
SIZED = ("smoke", "small", "paper")
LONGEST_S = 900


@dataclass(frozen=True)
class Desk:
    """A reader's folder.

    Attributes:
        folder: Where commands run.
        womd: What ``$WOMD`` names: records.
    """

    folder: Path
    womd: Path

    def run(self, block: Block) -> None:
        """Do what a block says; it must end as it says, and print what it says."""
        if block.language == "console":
            self._follow(block)
            return
        words = ["bash", "-euo", "pipefail", "-c", block.text]
        if block.language == "python":
            words = ["python", "-W", "error", "-c", block.text]
        done = self.call(words)
        assert done.returncode == block.exit_code, self.told(block, block.text, done)

    def _follow(self, block: Block) -> None:
        steps = commands(block)
        for number, (command, printed) in enumerate(steps):
            done = self.call(["bash", "-o", "pipefail", "-c", command])
            expected = block.exit_code if number == len(steps) - 1 else 0
            told = self.told(block, command, done)
            assert done.returncode == expected, told
            for line in printed:
                assert has_line(done.stdout + done.stderr, line), f"no {line!r} in {told}"

    def call(self, words: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            words,
            cwd=self.folder,
            env=self.environ,
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )

    @property
    def environ(self) -> dict[str, str]:
        return {
            **os.environ,
            "PATH": f"{self.folder / '.venv/bin'}:{os.environ['PATH']}",
            "WOMD": str(self.womd),
            "OMP_NUM_THREADS": "1",
        }

    @staticmethod
    def told(block: Block, command: str, done: subprocess.CompletedProcess[str]) -> str:
        about = f"{block.name}: {command}\nexit code {done.returncode}"
        return f"{about}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def has_line(output: str, line: str) -> bool:
    """Whether some line of the output reads like this; ``...`` stands for anything."""
    parts = [" ".join(part.split()) for part in line.split("...")]
    for candidate in output.splitlines():
        there, rest = True, " ".join(candidate.split())
        for part in parts:
            at = rest.find(part)
            there = there and at >= 0
            rest = rest[at + len(part) :]
        if there:
            return True
    return False


def tiny_stages() -> str:
    """The packaged ``stages.yaml`` with every profile that has a size made tiny.

    The demo keeps the size of the weights that it begins with, and does less with them.
    """
    stages = yaml.safe_load(DEFAULT_FILE.read_text())
    profiles = stages["profiles"]
    for name in SIZED:
        profiles[name] = {
            section: {**profiles[name].get(section, {}), **settings}
            for section, settings in profiles["tiny"].items()
        } | {"sources": "builtin"}
    for section in ("ingest", "rollout"):
        profiles["demo"][section] = profiles["tiny"][section]
    profiles["demo"]["train"] |= {"steps": 2, "batch_scenes": 2, "validation_scenes": 2}
    return yaml.safe_dump(stages, sort_keys=False)


def lay_out(folder: Path, womd: Path) -> Desk:
    """Put what a reader has into a folder: the clone's files and an environment."""
    folder.mkdir(parents=True)
    (folder / ".venv").symlink_to(sys.prefix)
    for name in ("examples", "benchmarks", "docs", "Makefile", "CHANGELOG.md"):
        (folder / name).symlink_to(REPOSITORY / name)
    (folder / "stages.yaml").write_text(tiny_stages())
    return Desk(folder, womd)


@pytest.fixture(scope="session")
def first(tmp_path_factory) -> Desk:
    """A reader's folder where ``FIRST`` was run, shared by all processes of the tests."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    womd, folder = shared / "docs-records", shared / "docs-first-run"
    with locked(shared / "docs-first-run.lock", wait=True):
        if not folder.is_dir():
            shutil.rmtree(womd, ignore_errors=True)
            shutil.copytree(builtin_records()[0].parent, womd)
            desk = lay_out(shared / f"docs-first-run.{os.getpid()}", womd)
            done = desk.call(["bash", "-c", FIRST])
            assert done.returncode == 0, done.stderr
            desk.folder.rename(folder)
    return Desk(folder, womd)


@pytest.fixture
def desk(tmp_path, first) -> Desk:
    """A reader's folder of one page, with a root ``work`` that is made already."""
    desk = lay_out(tmp_path / "desk", first.womd)
    shutil.copytree(first.folder / "work", desk.folder / "work", symlinks=True)
    return desk
