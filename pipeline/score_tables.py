"""From scored units to the tables of the ``score`` stage, one unit in memory at a time."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from infgen.config import ScoreSettings
from infgen.metrics.counts import mean_counts
from infgen.metrics.reference import Counts, add_up, divergence, log_probabilities
from infgen.metrics.table import Against, LogCounts, make_row
from infgen.metrics.windows import cut_windows
from pipeline.folders import write_json
from pipeline.score import REFERENCE, read_binned, read_counts
from pipeline.score_summary import Gathered, Summary, Tally
from pipeline.score_write import ScoreRow, join_parts, write_curves, write_part
from pipeline.stage import Done, Progress

LOG_PREFIX = "log/"
"""Before the metrics of a log that is scored as if it were a rollout."""


def gather(
    units: Sequence[Done], target: Path, settings: ScoreSettings, progress: Progress
) -> Gathered:
    """Score all units, and write the tables of scores and curves, and the summary."""
    logs = [done for done in units if done.report["kind"] == REFERENCE]
    played = [done for done in units if done.report["kind"] != REFERENCE]
    logged = add_up(read_counts(done.path) for done in logs)
    simulated = add_up(read_counts(done.path) for done in played)
    against = _against(logs, logged, settings)

    parts = target / "parts"
    parts.mkdir()
    log_tally, tally = Tally(), Tally()
    wosac: dict[str, dict[str, Any]] = {}
    for at, done in enumerate(units):
        progress(at, len(units), "units scored")
        is_log = done.report["kind"] == REFERENCE
        rows = _score(done, against, log_tally if is_log else tally, is_log=is_log)
        official = {} if is_log else _read_wosac(done.path)
        rows += _wosac_rows(official, settings.wosac)
        wosac |= official
        write_part(parts / f"{at:06d}.parquet", rows)
    join_parts(parts, target / "scores.parquet")
    write_curves(target / "curves.parquet", tally)
    summary = Summary(settings, tally, log_tally, divergence(logged, simulated), wosac)
    missing = sorted({scene for done in played for scene in done.report["missing"]})
    write_json(target / "summary.json", summary.build(missing, _skipped(logs)))
    return summary.report(missing)


def _against(logs: Sequence[Done], logged: Counts, settings: ScoreSettings) -> Against:
    """Read the counts of all logs, a group at a time."""
    counts = {
        one.scenario_id: LogCounts(one.num_near, one.num_all)
        for done in logs
        for one in read_binned(done.path)
    }
    means = []
    for log in counts.values():
        windows = cut_windows(len(log.near), settings.window_s, settings.stride_s)
        means.append([mean_counts(n, windows)[0] for n in (log.near, log.all)])
    near, everyone = np.mean(means, axis=0) if means else (np.nan, np.nan)
    return Against(
        log_p=log_probabilities(logged),
        split_near=float(near),
        split_all=float(everyone),
        logs=counts,
        window_s=settings.window_s,
        stride_s=settings.stride_s,
    )


def _score(done: Done, against: Against, tally: Tally, *, is_log: bool) -> list[ScoreRow]:
    """Score the rollouts, or the logs as if they were rollouts, of one unit."""
    rows: list[ScoreRow] = []
    for binned in read_binned(done.path):
        row = make_row(binned, against)
        tally.add(binned.scenario_id, row)
        rollout = None if is_log else binned.index
        prefix = LOG_PREFIX if is_log else ""
        rows += [
            ScoreRow(binned.scenario_id, rollout, f"{prefix}{name}", value)
            for name, value in row.numbers.items()
        ]
    tally.close_unit()
    return rows


def _read_wosac(folder: Path) -> dict[str, dict[str, Any]]:
    """Official scores, or why there are none, by scenario id."""
    found = json.loads((folder / "wosac.json").read_text())
    return {entry["scenario_id"]: entry for entry in found}


def _wosac_rows(official: Mapping[str, Any], version: str) -> list[ScoreRow]:
    return [
        ScoreRow(scenario_id, None, f"{version}/{name}", value)
        for scenario_id, entry in official.items()
        for name, value in entry.get("scores", {}).items()
    ]


def _skipped(logs: Sequence[Done]) -> list[str]:
    """Logs that could not be measured, each with the reason."""
    return [
        f"{scenario_id}: {reason}"
        for done in logs
        for scenario_id, reason in done.report["skipped"].items()
    ]
