"""``infgen plan --preset``: what a comparison will take, and what fits into a time."""

import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from infgen.errors import ConfigError
from pipeline.commands.options import ComparisonOptions, EstimateOptions, RequestOptions
from pipeline.commands.screen import console, gibibytes, show_table
from pipeline.commands.verbs import print_json
from pipeline.comparison.estimate import (
    Budget,
    Estimated,
    clock_hours,
    estimate,
    fit,
)
from pipeline.comparison.probe import PLAYED_S, Probe, probe
from pipeline.comparison.records import waits_for_towns, with_towns
from pipeline.comparison.runs import ROLLOUT, TRAIN, ArmRun, Comparison, arm_runs_of
from pipeline.comparison.workload import workload
from pipeline.engine.plan import PlanError
from pipeline.storage.sources.source_files import find_records
from pipeline.workers.dask_cluster import parse

HOURS = {"m": 1 / 60, "h": 1.0, "d": 24.0}
"""Hours of each unit that a budget may be given in."""


@dataclass(frozen=True, slots=True)
class _Told:
    """All that is told of a comparison.

    Attributes:
        stages: Its work.
        hours: By the clock.
        workers: That do units at once.
        probe: What was measured.
        budget: What fits into the time there is; None where none was given.
    """

    stages: Sequence[Estimated]
    hours: float
    workers: int
    probe: Probe
    budget: Budget | None


def estimate_arms(
    request_options: RequestOptions,
    comparing: ComparisonOptions,
    estimating: EstimateOptions,
    *,
    as_json: bool,
) -> None:
    """Print what all arms of a preset will take; nothing but the probe is run.

    Raises:
        ConfigError: for a preset, records or words that cannot be.
        PlanError: if nothing of the work fits into the budget, or towns are not written.
    """
    comparison = comparing.comparison(request_options, [])
    if files := waits_for_towns(comparison):
        raise PlanError(
            f"{files} files of towns are not written yet, and estimates need records; "
            f"`infgen run ingest --preset {comparison.preset.name}` writes them"
        )
    comparison = with_towns(comparison)
    preset = comparison.preset
    arms = preset.chosen(comparing.arm_names)
    arm_runs = arm_runs_of(comparison, arms, comparing.seeds or preset.seeds)
    records = find_records(comparison.records or comparison.file.base.sources)
    measured = probe(comparison, arm_runs, records, _tell)
    workers = num_workers(estimating.dask)
    found = estimate(workload(comparison, arm_runs, measured.splits), measured.costs)
    hours = clock_hours(found, workers)
    budget = None
    if estimating.budget is not None:
        asked = hours_of(estimating.budget)
        budget = _choose(comparison, arm_runs, measured, asked, workers, hours)
    told = _Told(found, hours, workers, measured, budget)
    if as_json:
        print_json(asdict(told))
    else:
        _show(told, estimating.budget)


def _tell(run: str) -> None:
    _say(f"probe: {run}", stderr=True)


def _say(line: str, *, stderr: bool = False) -> None:
    console(stderr=stderr).print(line, soft_wrap=True, markup=False, highlight=False)


def num_workers(dask: str) -> int:
    """Count the workers that ``--dask`` names; a cluster elsewhere counts as one.

    Raises:
        ConfigError: for words that name no kind of workers.
    """
    kind, rest = ("none", "") if dask == "none" else parse(dask)
    if kind == "local":
        return int(rest or os.cpu_count() or 1)
    if kind == "gpu" and re.fullmatch(r"\d+(,\d+)*", rest):
        return len(rest.split(","))
    return 1


def hours_of(word: str) -> float:
    """Read a time such as ``24h``, ``90m`` or ``2d``.

    Raises:
        ConfigError: naming the word and what was expected.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([mhd])", word)
    if match is None or not float(match[1]):
        raise ConfigError(f"--budget {word}: expected a time, as 24h, 90m or 2d")
    return float(match[1]) * HOURS[match[2]]


def _choose(
    comparison: Comparison,
    arm_runs: Sequence[ArmRun],
    measured: Probe,
    asked: float,
    workers: int,
    hours: float,
) -> Budget:
    """Choose steps and scenes for a time; both go over the settings of every arm."""
    plans = [comparison.sketch(arm_run) for arm_run in arm_runs]
    steps = max(plan[TRAIN].settings["train"].steps for plan in plans)
    played = plans[0][ROLLOUT].settings
    scenes = min(
        measured.splits[played.split].scenes,
        played.max_scenes or measured.splits[played.split].scenes,
    )
    if hours <= asked:
        return Budget(share=1.0, steps=steps, scenes=scenes, wider=1.0)
    words = (f"train.steps={steps}", f"rollout.max_scenes={scenes}")
    alike = replace(comparison, overrides=(*comparison.overrides, *words))
    whole = estimate(workload(alike, arm_runs, measured.splits), measured.costs)
    found = fit(whole, asked, workers, steps, scenes)
    if found is None:
        fixed = clock_hours((one for one in whole if not one.is_scaled), workers)
        raise PlanError(
            f"--budget: records to tokens alone take {fixed:.3g} hours, expected less "
            f"than {asked:.3g}; read fewer scenes of each file "
            "(-s ingest.max_scenes_per_file=N), or use more workers (--dask)"
        )
    return found


def _show(told: _Told, budget: str | None) -> None:
    rows = [
        (
            each.stage,
            each.run,
            f"{each.amount:,} {each.items}",
            each.hours,
            gibibytes(round(each.bytes)),
            f"{each.files:,}",
        )
        for each in told.stages
    ]
    total = sum(each.hours for each in told.stages)
    files = sum(each.files for each in told.stages)
    stored = gibibytes(round(sum(each.bytes for each in told.stages)))
    rows.append(("all", "", "", total, stored, f"{files:,}"))
    columns = ("stage", "run", "work", "hours of a core or GPU", "on disk", "files")
    show_table("What it takes, from nothing", columns, rows)
    for line in _lines(told, budget):
        _say(line)


def _lines(told: _Told, budget: str | None) -> Sequence[str]:
    """What must be known of the table."""
    seconds = told.probe.seconds
    when = f"now, in {seconds:.0f} s" if seconds else "before, with the same settings"
    counted = ", ".join(
        f"{split}: {one.scenes:,} scenes (counted in {one.counted} of {one.files:,} files)"
        for split, one in sorted(told.probe.splits.items())
    )
    lines = [
        f"By the clock {told.hours:.3g} hours: units on {told.workers} workers, training "
        "on one.",
        counted,
        f"Measured on this machine {when}: a few scenes through every stage. "
        "Extrapolated: all numbers of scenes, steps and rollouts, and rollouts of more "
        f"than {PLAYED_S:g} s; ablations count as the method they are of. Left out: "
        "clustering the vocabularies (minutes), and gathering the units of each stage.",
    ]
    if told.budget is not None:
        lines.append(_words(told.budget, str(budget)))
    return lines


def _words(budget: Budget, asked: str) -> str:
    if budget.share >= 1:
        return f"All of it fits into {asked}."
    return (
        f"Into {asked} fit {budget.share:.1%} of the steps and of the simulated scenes: "
        f"{' '.join(f'-s {word}' for word in budget.words)}. Intervals of scores get "
        f"{budget.wider:.1f} times as wide (one over the root of the scenes); what fewer "
        "steps cost, only training tells."
    )
