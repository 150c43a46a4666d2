"""How near the estimate of ``infgen plan --preset`` comes to what the same work takes.

The work of some arms is estimated from a probe, by a process of its own, and then truly
done, in this process and with the same clock: seconds of a core, so that other work on the
machine does not count. The promise: the sum is within 25 %.

    python benchmarks/estimate.py [RECORDS...]
    python benchmarks/estimate.py towns/* --preset paper --profile tiny --arms all \
        -s ingest.max_scenes_per_file=0 train.steps=24 rollout.max_scenes=44
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from pipeline.comparison.estimate import S_PER_HOUR, TRAINING, estimate
from pipeline.comparison.execution import execute_arm_runs
from pipeline.comparison.probe import probe
from pipeline.comparison.runs import SCORE, TRAIN, ArmRun, Comparison, arm_runs_of
from pipeline.comparison.workload import SCORED_LOGS, workload
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.plan import Plan
from pipeline.engine.runner import RunOptions
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.storage.sources.source_files import find_records
from pipeline.workers.measured import MeasuredWorkers

GOAL = 0.25
PART_OF = {SCORED_LOGS: SCORE, **dict.fromkeys(TRAINING, TRAIN)}
"""Stages of what is estimated apart."""
SETTINGS = ("train.steps=40", "rollout.max_scenes=6", "rollout.count=4")
EVERY = "all"


def main() -> None:
    """Estimate, do it, print both, and last one line of JSON."""
    asked = _arguments().parse_args()
    with tempfile.TemporaryDirectory(prefix="infgen-bench-", dir=asked.folder) as folder:
        root = asked.root or Path(folder)
        comparison, arm_runs = _requested(asked, root)
        if asked.root:  # This is the process that only estimates.
            print(json.dumps(estimated_s(comparison, arm_runs)))
            return
        command = [sys.executable, *sys.argv, "--root", folder]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        expected: list[dict[str, float]] = json.loads(done.stdout.splitlines()[-1])
        taken, besides_s = taken_s(comparison, arm_runs, expected)
        print(f"{'not estimated':14}{'':12}{besides_s:10.1f}")
        print(json.dumps(figures(expected[-1], taken, besides_s)))


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("records", nargs="*", default=["builtin"])
    parser.add_argument("--preset", default="womd-mini")
    parser.add_argument("--profile", default="small", help="Empty for none.")
    parser.add_argument("--arms", nargs="+", default=["infgen"], help=f"Or: {EVERY}.")
    parser.add_argument("-s", dest="settings", nargs="+", default=list(SETTINGS))
    parser.add_argument("--folder", type=Path, help="Where; default: for temporary files.")
    parser.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    return parser


def _requested(asked: argparse.Namespace, root: Path) -> tuple[Comparison, list[ArmRun]]:
    file = load_stages(DEFAULT_FILE, {})
    comparison = Comparison(
        root=Root(root),
        path=DEFAULT_FILE,
        file=file,
        preset=file.preset(asked.preset),
        profile=asked.profile or None,
        overrides=tuple(asked.settings),
        records=tuple(asked.records),
        targets=("score",),
    )
    names = [] if asked.arms == [EVERY] else asked.arms
    return comparison, arm_runs_of(comparison, comparison.preset.chosen(names), 1)


def estimated_s(comparison: Comparison, arm_runs: list[ArmRun]) -> list[dict[str, float]]:
    """Estimated seconds of each stage: of the first run, of the first two, and so on."""
    records = find_records(comparison.records)
    measured = probe(comparison, arm_runs, records, tell=lambda run: None)
    sums = []
    for count in range(1, len(arm_runs) + 1):
        found: dict[str, float] = defaultdict(float)
        work = workload(comparison, arm_runs[:count], measured.splits)
        for each in estimate(work, measured.costs):
            found[PART_OF.get(each.stage, each.stage)] += each.hours * S_PER_HOUR
        sums.append(found)
    return sums


def taken_s(
    comparison: Comparison, arm_runs: list[ArmRun], expected: list[dict[str, float]]
) -> tuple[dict[str, float], float]:
    """Seconds that the units of each stage truly took, and those of all else.

    After each run the table so far is printed: the work may be ended before all is done.
    """
    workers = MeasuredWorkers(by_clock=False)

    def taken() -> dict[str, float]:
        return {
            stage: sum(unit.seconds for unit in units)
            for stage, units in workers.samples.items()
        }

    def options(plan: Plan) -> RunOptions:
        return RunOptions(workers=workers)

    begun = time.process_time()
    events = Events(comparison.root)
    for count in range(1, len(arm_runs) + 1):
        # Those before are found made; weights that others go on from are among them.
        for ran in execute_arm_runs(comparison, arm_runs[:count], options, events):
            if not ran.is_whole:
                raise RuntimeError(f"{ran.arm_run.words}: {ran.why}")
        show(f"{count} of {len(arm_runs)} runs", expected[count - 1], taken())
    all_s = time.process_time() - begun
    return taken(), all_s - sum(taken().values())


def rows_of(
    expected: Mapping[str, float], taken: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Estimated and taken seconds of each stage, and of all."""
    rows = {stage: (expected[stage], taken[stage]) for stage in taken}
    return rows | {"all": (sum(expected.values()), sum(taken.values()))}


def show(title: str, expected: Mapping[str, float], taken: Mapping[str, float]) -> None:
    """Print a table."""
    print(f"{title:14}{'estimated':>12}{'taken':>10}{'ratio':>8}  CPU seconds")
    for stage, (ours, true) in rows_of(expected, taken).items():
        print(f"{stage:14}{ours:12.1f}{true:10.1f}{ours / true:8.2f}", flush=True)


def figures(
    expected: Mapping[str, float], taken: Mapping[str, float], besides_s: float
) -> dict[str, object]:
    """Everything, JSON-able."""
    rows = rows_of(expected, taken)
    ours, true = rows["all"]
    return {
        "off": round(ours / true - 1, 3),
        "goal": GOAL,
        "rows": {stage: [round(x, 2) for x in pair] for stage, pair in rows.items()},
        "not_estimated": round(besides_s, 1),
    }


if __name__ == "__main__":
    main()
