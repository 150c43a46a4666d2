"""From the logs of a split to its counts, and to the logs' own scores under them."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from infgen.config import ReferenceSettings
from infgen.metrics.agent_count import mean_counts
from infgen.metrics.long_term.reference import add_up
from infgen.metrics.long_term.table import LogCounts, make_row
from infgen.metrics.proper.retrieval import LogCourse, sample_logs
from infgen.metrics.windows import cut_windows
from pipeline.engine.stage import Progress
from pipeline.stages import reference_files as files
from pipeline.stages.score.summary import Tally
from pipeline.stages.score.write import ROWS, join_parts, rows_of, write_part, write_tally

LOG_PREFIX = "log/"
"""Before the metrics of a log that is scored as if it were a rollout."""


def gather(
    units: Sequence[Path], target: Path, settings: ReferenceSettings, progress: Progress
) -> int:
    """Add up the units' counts, score their logs, and write both; returns the logs."""
    files.write_counts(target, add_up(files.read_counts(unit) for unit in units))
    files.write_means(target, *_means(units, settings))
    files.write_courses(target, sample_logs(_courses(units)))
    parts = target / "parts"
    parts.mkdir()
    tally, paths = Tally(), []
    for at, unit in enumerate(units):
        progress(at, len(units), "units scored")
        against = files.read_against(target, files.read_logged(unit), settings)
        rows = []
        for binned in files.read_binned(unit):
            row = make_row(binned, against)
            tally.add(binned.scenario_id, row)
            rows += rows_of(binned.scenario_id, None, row.numbers, LOG_PREFIX)
        tally.close_unit()
        paths.append(parts / f"{at:06d}.parquet")
        write_part(paths[-1], rows)
    join_parts(paths, target / ROWS)
    for path in paths:
        path.unlink()
    parts.rmdir()
    write_tally(target, tally)
    return len(tally.means)


def _courses(units: Sequence[Path]) -> Iterator[LogCourse]:
    """Read the courses of all logs, a unit in memory at a time."""
    for unit in units:
        yield from files.read_courses(unit)


def _means(units: Sequence[Path], settings: ReferenceSettings) -> tuple[float, float]:
    """Mean over the logs of the agents in the first window: near the ego, and all."""
    logs = {name: log for unit in units for name, log in files.read_logged(unit).items()}
    return mean_log_counts(logs, settings)


def mean_log_counts(
    logs: Mapping[str, LogCounts], settings: ReferenceSettings
) -> tuple[float, float]:
    """Mean over logs of the agents in the first window: near the ego, and all."""
    means = {}
    for scenario_id, log in logs.items():
        windows = cut_windows(len(log.near), settings.window_s, settings.stride_s)
        means[scenario_id] = [mean_counts(n, windows)[0] for n in (log.near, log.all)]
    if not means:
        return float("nan"), float("nan")
    near, everyone = np.mean(list(means.values()), axis=0)
    return float(near), float(everyone)
