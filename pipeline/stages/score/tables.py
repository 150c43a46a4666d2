"""From scored units to the tables of the ``score`` stage: small rows, no scoring."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from infgen.metrics.long_term.reference import add_up, divergence
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import read_json
from pipeline.engine.stage import FinishedUnit, Inputs, Progress
from pipeline.stages.reference_files import read_counts, write_counts
from pipeline.stages.score.proper import CURVES as PROPER_CURVES
from pipeline.stages.score.proper import ProperTally, read_proper, write_proper_curves
from pipeline.stages.score.proper_summary import summarize
from pipeline.stages.score.summary import Gathered, Summary, Tally
from pipeline.stages.score.write import ROWS, join_parts, read_tally, write_curves

WOSAC = "wosac.json"


def gather(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Gathered:
    """Join all units, and write the tables of scores and curves, and the summary."""
    reference = inputs.folder("reference")
    counts = add_up(read_counts(done.path) for done in units)
    write_counts(target, counts)
    parts = [folder / ROWS for folder in (reference, *(done.path for done in units))]
    join_parts(parts, target / "scores.parquet")
    tally, proper = Tally(), ProperTally()
    wosac: dict[str, dict[str, Any]] = {}
    for at, done in enumerate(units):
        progress(at, len(units), "units gathered")
        tally.merge(read_tally(done.path, done.report["rollouts"]))
        proper.merge(read_proper(done.path))
        wosac |= {one["scenario_id"]: one for one in read_json(done.path / WOSAC)}
    write_curves(target / "curves.parquet", tally)
    write_proper_curves(target / PROPER_CURVES, proper)
    summary = Summary(
        settings=settings["score"],
        reference=settings["reference"],
        tally=tally,
        log_tally=read_tally(reference, 0),
        divergence=divergence(read_counts(reference), counts),
        wosac=wosac,
    )
    missing = sorted({scene for done in units for scene in done.report["missing"]})
    skipped = _skipped(inputs.units("reference"))
    told = summary.build(missing, skipped)
    told["proper"] = summarize(proper, settings["score"], settings["reference"])
    write_json(target / "summary.json", told)
    return summary.report(missing)


def _skipped(logs: Sequence[FinishedUnit]) -> list[str]:
    """Logs that could not be measured, each with the reason."""
    return [
        f"{scenario_id}: {reason}"
        for done in logs
        for scenario_id, reason in done.report["skipped"].items()
    ]
