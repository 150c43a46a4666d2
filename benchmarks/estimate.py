"""How near the estimate of ``infgen plan --preset`` comes to what the same work takes.

The work of some arms is estimated from a probe, and then truly done, in this process and
with the same clock: seconds of a core, so that other work on the machine does not count.
The promise: the sum is within 25 %.

    python benchmarks/estimate.py [RECORDS...]
"""

import argparse
import json
import tempfile
from collections import defaultdict
from pathlib import Path

from pipeline.comparison.estimate import S_PER_HOUR, TRAINING, estimate
from pipeline.comparison.probe import probe
from pipeline.comparison.runs import SCORE, TRAIN, ArmRun, Comparison, arm_runs_of
from pipeline.comparison.workload import SCORED_LOGS, workload
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.runner import RunOptions, run
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.storage.sources.source_files import find_records
from pipeline.workers.measured import MeasuredWorkers

GOAL = 0.25
PART_OF = {SCORED_LOGS: SCORE, **dict.fromkeys(TRAINING, TRAIN)}
"""Stages of what is estimated apart."""
SETTINGS = ("train.steps=40", "rollout.max_scenes=6", "rollout.count=4")


def main() -> None:
    """Estimate, do it, print both, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("records", nargs="*", default=["builtin"])
    parser.add_argument("--preset", default="womd-mini")
    parser.add_argument("--profile", default="small")
    parser.add_argument("--arms", nargs="+", default=["infgen"])
    parser.add_argument("-s", dest="settings", nargs="+", default=list(SETTINGS))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="infgen-bench-") as folder:
        file = load_stages(DEFAULT_FILE, {})
        comparison = Comparison(
            root=Root(Path(folder)),
            path=DEFAULT_FILE,
            file=file,
            preset=file.preset(asked.preset),
            profile=asked.profile,
            overrides=tuple(asked.settings),
            records=tuple(asked.records),
            targets=("score",),
        )
        arm_runs = arm_runs_of(comparison, comparison.preset.chosen(asked.arms), 1)
        expected = estimated_s(comparison, arm_runs)
        report(expected, taken_s(comparison, arm_runs))


def estimated_s(comparison: Comparison, arm_runs: list[ArmRun]) -> dict[str, float]:
    """Estimated seconds of each stage."""
    records = find_records(comparison.records)
    measured = probe(comparison, arm_runs, records, tell=lambda run: None)
    found: dict[str, float] = defaultdict(float)
    for each in estimate(workload(comparison, arm_runs, measured.splits), measured.costs):
        found[PART_OF.get(each.stage, each.stage)] += each.hours * S_PER_HOUR
    return found


def taken_s(comparison: Comparison, arm_runs: list[ArmRun]) -> dict[str, float]:
    """Seconds that the units of each stage truly took."""
    workers = MeasuredWorkers(by_clock=False)
    for arm_run in arm_runs:
        plan = comparison.plan(arm_run)
        for result in run(plan, RunOptions(workers=workers), Events(comparison.root)):
            if result.state == "failed":
                raise RuntimeError(f"{arm_run.words}: {result.stage}: {result.errors}")
    return {
        stage: sum(unit.seconds for unit in units)
        for stage, units in workers.samples.items()
    }


def report(expected: dict[str, float], taken: dict[str, float]) -> None:
    """Print the table and the line of JSON."""
    print(f"{'CPU seconds':14}{'estimated':>12}{'taken':>10}{'ratio':>8}")
    rows = {stage: (expected[stage], taken[stage]) for stage in taken}
    rows["all"] = (sum(expected.values()), sum(taken.values()))
    for stage, (ours, true) in rows.items():
        print(f"{stage:14}{ours:12.1f}{true:10.1f}{ours / true:8.2f}")
    ours, true = rows["all"]
    figures = {stage: [round(x, 2) for x in pair] for stage, pair in rows.items()}
    print(json.dumps({"off": round(ours / true - 1, 3), "goal": GOAL, "rows": figures}))


if __name__ == "__main__":
    main()
