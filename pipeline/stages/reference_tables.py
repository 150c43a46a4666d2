"""From the counts of each file's logs to those of a split."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from infgen.config import ReferenceSettings
from infgen.metrics.agent_count import mean_counts
from infgen.metrics.long_term.reference import add_up
from infgen.metrics.long_term.table import LogCounts
from infgen.metrics.proper.retrieval import LogCourse, sample_logs
from infgen.metrics.windows import cut_windows
from pipeline.stages import reference_files as files


def gather(units: Sequence[Path], target: Path, settings: ReferenceSettings) -> None:
    """Add up the units' counts, and write them, mean numbers of agents and a sample."""
    files.write_counts(target, add_up(files.read_counts(unit) for unit in units))
    files.write_means(target, *_means(units, settings))
    files.write_courses(target, sample_logs(_courses(units)))


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
