"""Kill stages at random moments, run again, and compare every byte with a quiet run.

    python tests/kill_and_resume.py --kills 20 --records '../data/*.tfrecord*'
    python tests/kill_and_resume.py --kills 23 --profile tiny --stages all --workers
    python tests/kill_and_resume.py --kills 10 --profile tiny --stages rollout \\
        --set ingest.max_scenes_per_file=6 rollout.max_scenes=6 rollout.count=2 \\
        --victims run worker workers scheduler
    python tests/kill_and_resume.py --profile tiny --kills 0 --workers --throughout 8 \\
        --every-s 12 --longest-s 7200 --records '../towns/*.tfrecord*'

For each stage and kill: start the stage, wait until it is at work, SIGKILL a victim at a
random (seeded) moment, check that all that looks whole is whole, run again, check that only
what was not done is done again, and compare what was made with what an uninterrupted run
made. The victim is the whole run (its process group) or, of a Dask cluster of processes of
their own, a worker, all workers or the scheduler. A run must survive the loss of workers,
and end with exit code 1 and one line about it when the scheduler is lost. Then compare the
in-process executor with one, two and four workers. With ``--throughout`` a whole report is
at last made by so many workers, of which one after the other is killed until it is done.

Runs are forked from this process, which has imported everything, so they start at once.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HERE))

from pipeline.engine.atomic import MANIFEST, PARTIAL  # noqa: E402
from pipeline.engine.layout import Root  # noqa: E402
from pipeline.engine.manifest import verify  # noqa: E402
from tests.clusters import Cluster  # noqa: E402
from tests.runs import ForkedRun, Run, StartedRun, wait  # noqa: E402

STAGES = ("ingest", "build-vocab", "tokenize")
ALL_STAGES = (*STAGES, "train", "calibrate", "rollout", "reference", "score", "report")
VICTIMS = ("run", "worker", "workers", "scheduler")
WORKERS = ("local:1", "local:2", "local:4")
PER_RUN = {
    "run.json",
    "lock",
    "attempt.json",
    "pace.jsonl",
    "trained.json",
    "passport.html",
}
"""Files that tell of machines and times, which no manifest lists."""
POLL_S = 0.005
TRIES = 4
"""A kill that comes when all is done does not count; the next draws another moment."""
KILLS_IN_TURN = 5
LONGEST_S = 600.0
CLUSTER_WORKERS = 2
LOST = "the Dask scheduler"
FAILED = 1


@dataclass(frozen=True)
class Trial:
    """A small job: its words on the command line, and where it happens."""

    words: tuple[str, ...]
    folder: Path
    starter: Callable[[Sequence[str], Path], Run] = StartedRun
    longest_s: float = LONGEST_S

    @property
    def said(self) -> Path:
        """What the last run says, or said."""
        return self.folder / "said.log"

    def start(self, stage: str, root: Path, *more: str) -> Run:
        """Start to make a stage, in a process group of its own."""
        words = ("run", stage, "--root", str(root), *self.words, *more)
        return self.starter(words, self.said)

    def end(self, running: Run) -> str:
        """Wait for the end of the last run; return all it said."""
        wait(running, self.longest_s)
        return self.said.read_text(errors="replace")

    def make(self, stage: str, root: Path, *more: str) -> None:
        """Make a stage without any trouble."""
        running = self.start(stage, root, *more)
        said = self.end(running)
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

    def kill_once(
        self, stage: str, root: Path, victim: str, delay_s: float, number: int
    ) -> bool:
        """Start a stage and kill so long after it began; False if it was done before."""
        if victim == "run":
            running = self.start(stage, root)
            kill = partial(os.killpg, running.pid, signal.SIGKILL)
            return self._kill(running, stage, root, delay_s, kill)[0]
        folder = self.folder / "cluster"
        folder.mkdir(exist_ok=True)
        cluster = Cluster(folder, [str(HERE)])
        kills = {
            "worker": partial(cluster.kill_worker, number),
            "workers": cluster.kill_workers,
            "scheduler": cluster.kill_scheduler,
        }
        try:
            cluster.start(CLUSTER_WORKERS)
            running = self.start(stage, root, "--dask", cluster.words)
            in_time, said = self._kill(running, stage, root, delay_s, kills[victim])
        finally:
            cluster.stop()
        lost = victim == "scheduler" and LOST in said.splitlines()[-1]
        if running.returncode and not (lost and running.returncode == FAILED):
            raise SystemExit(f"{stage} left with {running.returncode}:\n{said}")
        return in_time

    def _kill(
        self, running: Run, stage: str, root: Path, delay_s: float, kill: Callable[[], None]
    ) -> tuple[bool, str]:
        """Kill at a moment of a stage; tell if it was in time, and all the run said."""
        attempt = Root(root).attempt(stage)
        while running.poll() is None and not attempt.exists():
            time.sleep(POLL_S)
        time.sleep(delay_s)
        in_time = running.poll() is None
        if in_time:
            kill()
        return in_time, self.end(running)


def done_units(root: Path, stage: str) -> dict[str, int]:
    """When each unit that is there was made, in the file system's own time."""
    manifests = Root(root).units(stage).glob(f"*/{MANIFEST}")
    return {
        path.parent.name: path.stat().st_mtime_ns
        for path in manifests
        if not path.parent.name.endswith(PARTIAL)
    }


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


def kill_stage(
    trial: Trial, stage: str, quiet: Path, kills: int, seed: int, victim: str = "run"
) -> int:
    """Kill a stage so often, and check what is there after each kill and each new run.

    Returns:
        Units that were done before kills, and stayed as they were.
    """
    root = trial.folder / f"killed-{stage}-{victim}"
    shutil.copytree(quiet, root, symlinks=True)
    expected, duration_s = digest(quiet, (stage,)), trial.seconds(stage, quiet)
    draw = random.Random(f"{seed} {stage} {victim}")
    in_time = number = kept = 0
    while in_time < kills:
        number += 1
        if number > TRIES * kills:
            raise SystemExit(f"{stage}: only {in_time} of {number} kills came in time")
        shutil.rmtree(Root(root).stage(stage))
        delay_s = draw.uniform(0, duration_s)
        hit = trial.kill_once(stage, root, victim, delay_s, number)
        # A run that was done before is one of a machine less busy than the quiet run's.
        in_time, duration_s = in_time + hit, duration_s if hit else delay_s
        what = f"{stage}, kill {number} of a {victim} after {delay_s:.3f} s"
        damage = list(verify(Root(root), full=True))
        if damage:
            raise SystemExit(f"{what}: {damage}")
        before = done_units(root, stage)
        kept += len(before)
        trial.make(stage, root)
        compare(digest(root, (stage,)), expected, what)
        again = before.items() - done_units(root, stage).items()
        if again:
            raise SystemExit(f"{what}: units that were done were done again: {again}")
    shutil.rmtree(root)
    return kept


def compare_workers(
    trial: Trial, workers: str, quiet: Path, stages: tuple[str, ...]
) -> None:
    """Make some stages of a quiet run again, by some workers."""
    root = trial.folder / workers.replace(":", "-")
    shutil.copytree(quiet, root, symlinks=True)
    for stage in stages:
        shutil.rmtree(Root(root).stage(stage))
    trial.make(stages[-1], root, "--dask", workers)
    compare(digest(root, stages), digest(quiet, stages), f"--dask {workers}")
    shutil.rmtree(root)


def kill_throughout(
    trial: Trial, quiet: Path, workers: int, every_s: float, seed: int
) -> tuple[int, int]:
    """Make all stages by workers of which one after the other is killed; compare the bytes.

    A run that a unit failed in, because each of its workers was killed, is run again.

    Args:
        trial: The job.
        quiet: Root of its quiet run.
        workers: How many there are, restarted as they die.
        every_s: Seconds between two kills, on average.
        seed: Of the moments and victims.

    Returns:
        Number of kills, and of runs.
    """
    root, folder = trial.folder / "killed-throughout", trial.folder / "cluster"
    folder.mkdir(exist_ok=True)
    cluster, draw = Cluster(folder, [str(HERE)]), random.Random(seed)
    kills = runs = 0
    try:
        cluster.start(workers)
        while runs < TRIES:
            runs += 1
            running = trial.start(ALL_STAGES[-1], root, "--dask", cluster.words)
            while running.poll() is None:
                time.sleep(draw.uniform(0, 2 * every_s))
                if running.poll() is None:
                    cluster.kill_worker(draw.randrange(workers))
                    kills += 1
            said = trial.end(running)
            if not running.returncode:
                break
        else:
            raise SystemExit(f"{TRIES} runs left with {running.returncode}:\n{said}")
    finally:
        cluster.stop()
    compare(digest(root, ALL_STAGES), digest(quiet, ALL_STAGES), f"{kills} kills")
    shutil.rmtree(root)
    return kills, runs


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def kill_in_turn(
    trial: Trial,
    quiet: Path,
    targets: tuple[tuple[str, str], ...],
    asked: argparse.Namespace,
) -> None:
    """Kill stages in turn, a few times each, until all kills are done or time is up."""
    ends_at = time.monotonic() + 60 * asked.minutes
    done = dict.fromkeys(targets, (0, 0))
    for first in range(0, asked.kills, KILLS_IN_TURN):
        for stage, victim in targets:
            if time.monotonic() > ends_at:
                return
            kills, kept = done[stage, victim]
            more = min(KILLS_IN_TURN, asked.kills - first)
            kept += kill_stage(trial, stage, quiet, more, asked.seed + first, victim)
            done[stage, victim] = kills + more, kept
            say(
                f"{stage}: a {victim} killed {kills + more} times, all bytes equal after a "
                f"new run; {kept} units done before stayed as they were"
            )


def main(arguments: list[str] | None = None) -> None:
    """Do the whole trial and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", default="builtin")
    parser.add_argument("--profile", default="smoke")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=1e9, help="no kills after these")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", nargs="*", default=list(STAGES), help="or: all")
    parser.add_argument("--workers", nargs="*", default=list(WORKERS))
    parser.add_argument("--victims", nargs="*", default=["run"], choices=VICTIMS)
    parser.add_argument("--throughout", type=int, default=0, help="workers to be killed")
    parser.add_argument("--every-s", type=float, default=5.0, help="of --throughout")
    parser.add_argument("--longest-s", type=float, default=LONGEST_S, help="of one run")
    parser.add_argument("--set", nargs="*", default=[], help="stage.key=value")
    asked = parser.parse_args(arguments)
    killed = ALL_STAGES if asked.stages == ["all"] else tuple(asked.stages)
    stages = ALL_STAGES if asked.throughout else killed or STAGES
    stages = tuple(sorted(stages, key=ALL_STAGES.index))
    with tempfile.TemporaryDirectory() as folder:
        words = ("--records", asked.records, "--profile", asked.profile)
        settings = [word for given in asked.set for word in ("-s", given)]
        trial = Trial((*words, *settings), Path(folder), ForkedRun, asked.longest_s)
        quiet = trial.folder / "quiet"
        trial.make(stages[-1], quiet)
        say(f"quiet run: {len(digest(quiet, stages))} files of {', '.join(stages)}")
        kill_in_turn(trial, quiet, tuple(product(killed, asked.victims)), asked)
        for workers in asked.workers:
            compare_workers(trial, workers, quiet, stages)
            say(f"--dask {workers}: all bytes equal to --dask none")
        if asked.throughout:
            each = (asked.throughout, asked.every_s, asked.seed)
            kills, runs = kill_throughout(trial, quiet, *each)
            say(
                f"{asked.throughout} workers killed {kills} times in a whole report of "
                f"{runs} run(s): all bytes equal to --dask none"
            )


if __name__ == "__main__":
    main()
