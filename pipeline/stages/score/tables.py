"""From scored units to the tables of the ``score`` stage: they are only joined."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from infgen.metrics.intervals import Bootstrap
from infgen.metrics.long_term.reference import add_up, divergence
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import read_json
from pipeline.engine.stage import FinishedUnit, Inputs, Progress
from pipeline.stages.reference_files import read_counts, write_counts
from pipeline.stages.score.gathered import read_means, read_proper_table, read_sums
from pipeline.stages.score.proper import CURVES as PROPER_CURVES
from pipeline.stages.score.proper import SUMS as PROPER_SUMS
from pipeline.stages.score.proper import write_proper_curves
from pipeline.stages.score.proper_summary import summarize
from pipeline.stages.score.summary import Gathered, Summary, figures
from pipeline.stages.score.write import ROWS, SUMS, join_parts, write_curves

LOGS, ROLLOUTS = "logs", "rollouts"
"""What a unit scored, in its report."""
WOSAC = "wosac.json"
STEPS = 5


def gather(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Gathered:
    """Join all units, and write the tables of scores and curves, and the summary."""
    logs = [done.path for done in units if LOGS in done.report]
    played = [done for done in units if ROLLOUTS in done.report]
    folders = [done.path for done in played]
    join_parts([folder / ROWS for folder in (*logs, *folders)], target / "scores.parquet")
    progress(1, STEPS, "scores joined")
    counts = add_up(read_counts(folder) for folder in folders)
    write_counts(target, counts)
    progress(2, STEPS, "counts added up")
    write_curves(target / "curves.parquet", read_sums(folders, SUMS))
    proper_sums = read_sums(folders, PROPER_SUMS)
    write_proper_curves(target / PROPER_CURVES, proper_sums)
    progress(3, STEPS, "curves added up")
    draws = Bootstrap(settings["score"].bootstrap_resamples, settings["score"].seed)
    summary = Summary(
        settings=settings["score"],
        reference=settings["reference"],
        draws=draws,
        means=read_means(folders),
        rollouts=sum(done.report[ROLLOUTS] for done in played),
        log_means=read_means(logs),
        divergence=divergence(read_counts(inputs.folder("reference")), counts),
        wosac={
            one["scenario_id"]: one
            for folder in folders
            for one in read_json(folder / WOSAC)
        },
    )
    missing = sorted({scene for done in played for scene in done.report["missing"]})
    told = summary.build(missing, _skipped(inputs.units("reference")))
    progress(4, STEPS, "intervals of scores")
    proper = read_proper_table(folders)
    told["proper"] = summarize(proper, proper_sums, draws, settings["reference"])
    write_json(target / "summary.json", told)
    return figures(told, missing)


def _skipped(logs: Sequence[FinishedUnit]) -> list[str]:
    """Logs that could not be measured, each with the reason."""
    return [
        f"{scenario_id}: {reason}"
        for done in logs
        for scenario_id, reason in done.report["skipped"].items()
    ]
