"""Kill stages at random moments, run again, and compare every byte with a quiet run.

    python tests/kill_and_resume.py --kills 20 --records '../data/*.tfrecord*'
    python tests/kill_and_resume.py --kills 20 --profile tiny --stages train --workers

For each stage and kill: start the stage in a process group of its own, wait until it is at
work, SIGKILL the group at a random (seeded) moment, check that all that looks whole is
whole, run again, and compare what was made with what an uninterrupted run made. At last
compare the in-process executor with one, two and four workers.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HERE))

from pipeline.manifest import verify  # noqa: E402
from pipeline.root import Root  # noqa: E402

STAGES = ("ingest", "build-vocab", "tokenize")
WORKERS = ("local:1", "local:2", "local:4")
PER_RUN = {"run.json", "lock", "attempt.json", "pace.jsonl"}
POLL_S = 0.005
TRIES = 4
"""A kill that comes when all is done does not count; the next draws another moment."""
LONGEST_S = 600


@dataclass(frozen=True)
class Trial:
    """A small job: its words on the command line, and where it happens."""

    words: tuple[str, ...]
    folder: Path

    def start(self, stage: str, root: Path, *more: str) -> subprocess.Popen:
        """Start to make a stage, in a process group of its own."""
        command = [sys.executable, "-m", "infgen", "run", stage, "--root", str(root)]
        return subprocess.Popen(
            [*command, *self.words, *more],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONPATH": str(HERE)},
            start_new_session=True,
        )

    def make(self, stage: str, root: Path, *more: str) -> None:
        """Make a stage without any trouble."""
        running = self.start(stage, root, *more)
        said, _ = running.communicate(timeout=LONGEST_S)
        if running.returncode:
            raise SystemExit(f"infgen run {stage} left with {running.returncode}:\n{said}")

    def seconds(self, stage: str, root: Path) -> float:
        """How long a stage was at work in the quiet run."""
        for log in sorted(root.glob("logs/*.jsonl")):
            about = [json.loads(line) for line in log.read_text().splitlines()]
            times = [
                time.mktime(time.strptime(event["time"][:19], "%Y-%m-%dT%H:%M:%S"))
                + float(event["time"][19:23])
                for event in about
                if event.get("stage") == stage
            ]
            if times and any(event["event"] == "stage-done" for event in about):
                return times[-1] - times[0]
        raise SystemExit(f"no log says that {stage} was made")

    def kill_once(self, stage: str, root: Path, delay_s: float) -> bool:
        """Start a stage and kill it so long after it began; False if it was done before."""
        running = self.start(stage, root)
        attempt = Root(root).attempt(stage)
        while running.poll() is None and not attempt.exists():
            time.sleep(POLL_S)
        time.sleep(delay_s)
        killed = running.poll() is None
        if killed:
            os.killpg(running.pid, signal.SIGKILL)
        running.communicate()
        return killed


def digest(root: Path, stages: tuple[str, ...] = STAGES) -> dict[str, str]:
    """Checksum of every artefact of some stages, by its path."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for stage in stages
        for path in sorted(Root(root).stage(stage).rglob("*"))
        if path.is_file() and path.name not in PER_RUN
    }


def compare(found: dict[str, str], expected: dict[str, str], what: str) -> None:
    """Stop if artefacts differ, naming some that do."""
    names = sorted(found.keys() | expected.keys())
    differ = [name for name in names if found.get(name) != expected.get(name)]
    if differ:
        raise SystemExit(f"{what}: {len(differ)} files differ: {differ[:5]}")


def kill_stage(trial: Trial, stage: str, quiet: Path, kills: int, seed: int) -> None:
    """Kill a stage so often, and check what is there after each kill and each new run."""
    root = trial.folder / f"killed-{stage}"
    shutil.copytree(quiet, root, symlinks=True)
    expected, length_s = digest(quiet, (stage,)), trial.seconds(stage, quiet)
    draw = random.Random(f"{seed} {stage}")
    in_time = number = 0
    while in_time < kills:
        number += 1
        if number > TRIES * kills:
            raise SystemExit(f"{stage}: only {in_time} of {number} kills came in time")
        shutil.rmtree(Root(root).stage(stage))
        delay_s = draw.uniform(0, length_s)
        in_time += trial.kill_once(stage, root, delay_s)
        damage = list(verify(Root(root), full=True))
        if damage:
            raise SystemExit(f"{stage}, kill {number} after {delay_s:.3f} s: {damage}")
        trial.make(stage, root)
        compare(digest(root, (stage,)), expected, f"{stage}, kill {number}")
    shutil.rmtree(root)


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Do the whole trial and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", default="builtin")
    parser.add_argument("--profile", default="demo")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", nargs="*", default=list(STAGES))
    parser.add_argument("--workers", nargs="*", default=list(WORKERS))
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        words = ("--records", asked.records, "--profile", asked.profile)
        trial = Trial(words, Path(folder))
        quiet = trial.folder / "quiet"
        trial.make((asked.stages or STAGES)[-1], quiet)
        say(f"quiet run: {len(digest(quiet))} files")
        for stage in asked.stages:
            kill_stage(trial, stage, quiet, asked.kills, asked.seed)
            say(f"{stage}: killed {asked.kills} times, all bytes equal after a new run")
        for workers in asked.workers:
            root = trial.folder / workers.replace(":", "-")
            trial.make(STAGES[-1], root, "--dask", workers)
            compare(digest(root), digest(quiet), f"--dask {workers}")
            say(f"--dask {workers}: all bytes equal to --dask none")


if __name__ == "__main__":
    main()
