"""Files of the stages ``reference`` and ``score`` that hold counts and bins."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from infgen.config import ReferenceSettings
from infgen.metrics.long_term.binned import Binned
from infgen.metrics.long_term.reference import Counts, log_probabilities
from infgen.metrics.long_term.table import Against, LogCounts
from infgen.metrics.proper.retrieval import LogCourse
from pipeline.engine.layout import read_json
from pipeline.storage.zarr_store import read_records, write_json, write_records

BINNED_SCHEMA, COUNTS_SCHEMA = "infgen.binned/1", "infgen.counts/1"
LOGGED_SCHEMA, COURSES_SCHEMA = "infgen.logged/1", "infgen.courses/1"
COUNTS, LOGGED, MEANS = "counts.zarr", "logged.zarr", "means.json"
COURSES = "courses.zarr"


@dataclass(frozen=True, slots=True)
class Logged:
    """Number of agents of one log at each step after now.

    Attributes:
        scenario_id: Id of the log.
        counts: The numbers.
    """

    scenario_id: str
    counts: LogCounts


def write_binned(target: Path, number: int, binned: Sequence[Binned]) -> None:
    """Write bins as a group of a number, if there are any."""
    if binned:
        path = target / f"binned-{number:06d}.zarr"
        write_records(path, binned, Binned, BINNED_SCHEMA, compress=True)


def read_binned(folder: Path) -> Iterator[Binned]:
    """Read the bins of one unit, a group in memory at a time."""
    for path in sorted(folder.glob("binned-*.zarr")):
        yield from read_records(path, Binned, BINNED_SCHEMA, whole=True)


def write_counts(target: Path, counts: Counts) -> None:
    """Write the histograms of some logs or rollouts.

    They are small, and read of every unit: uncompressed that takes a tenth of the time.
    """
    write_records(target / COUNTS, [counts], Counts, COUNTS_SCHEMA, compress=False)


def read_counts(folder: Path) -> Counts:
    """Read the histograms of a unit, or of a whole split."""
    return read_records(folder / COUNTS, Counts, COUNTS_SCHEMA, whole=True)[0]


def write_logged(target: Path, logged: Sequence[Logged]) -> None:
    """Write the numbers of agents of some logs."""
    write_records(target / LOGGED, logged, Logged, LOGGED_SCHEMA, compress=True)


def read_logged(folder: Path) -> dict[str, LogCounts]:
    """Read the numbers of agents of one file's logs, by scenario id."""
    logged = read_records(folder / LOGGED, Logged, LOGGED_SCHEMA, whole=True)
    return {one.scenario_id: one.counts for one in logged}


def write_courses(target: Path, logs: Sequence[LogCourse]) -> None:
    """Write the situations and courses of some logs."""
    write_records(target / COURSES, logs, LogCourse, COURSES_SCHEMA, compress=True)


def read_courses(folder: Path) -> list[LogCourse]:
    """Read the situations and courses of a unit's logs, or of the sample of a split's."""
    return list(read_records(folder / COURSES, LogCourse, COURSES_SCHEMA, whole=True))


def write_means(target: Path, near: float, everyone: float) -> None:
    """Write the split's mean numbers of agents; NaN where it has no log."""
    write_json(target / MEANS, {"near": repr(near), "all": repr(everyone)})


def read_against(
    folder: Path, logs: dict[str, LogCounts], settings: ReferenceSettings
) -> Against:
    """Read what rollouts are scored against.

    Args:
        folder: Of the finished stage ``reference``.
        logs: Numbers of agents of the scenes' own logs.
        settings: Of that stage.
    """
    means = read_json(folder / MEANS)
    return Against(
        log_p=log_probabilities(read_counts(folder)),
        split_near=float(means["near"]),
        split_all=float(means["all"]),
        logs=logs,
        window_s=settings.window_s,
        stride_s=settings.stride_s,
    )
