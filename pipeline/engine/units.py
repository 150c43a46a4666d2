"""One unit of work, done whole: the same code in the driver's process and on any worker."""

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pipeline.engine import signals
from pipeline.engine.atomic import MANIFEST, publish
from pipeline.engine.manifest import Run, read_manifest, split_report, write_manifest
from pipeline.engine.registry import load_stage
from pipeline.engine.stage import Progress, Report, Unit


class WorkersLostError(OSError):
    """The workers are gone, and nobody can tell how far they came.

    What they have finished is on disk; the next run goes on from there.
    """


@dataclass(frozen=True, slots=True)
class Task:
    """A unit on its way to a worker: paths and small plain values only.

    Attributes:
        module: Where the stage's code is.
        unit: What to do.
        target: Folder to make.
        settings: The stage's settings.
        about: What the manifest says besides the report.
    """

    module: str
    unit: Unit
    target: Path
    settings: Any
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a unit.

    Attributes:
        name: Of the unit.
        report: Its figures; None if it failed.
        seconds: Time it took.
        error: One line on why it failed.
        trace: Where it failed.
    """

    name: str
    report: Report | None
    seconds: float
    error: str = ""
    trace: str = ""


Tell = Callable[..., None]
"""``tell(event, **figures)``: of what happens to workers."""


@runtime_checkable
class Executor(Protocol):
    """Does tasks, and yields what became of each as it is known."""

    def run(
        self,
        tasks: Sequence[Task],
        may_start: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``may_start()`` is False."""


class InProcess:
    """Does one task after the other, here."""

    def run(
        self,
        tasks: Sequence[Task],
        may_start: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``may_start()`` is False."""
        for task in tasks:
            if not may_start():
                return
            yield attempt(task, progress)


@runtime_checkable
class OpenWorkers(Protocol):
    """Workers that are there while a run goes on."""

    def executor(self, *, here: bool) -> Executor:
        """Return who does the units of a stage; ``here`` if it must be this process."""


@runtime_checkable
class Workers(Protocol):
    """Where the units of a run are done (``--dask``).

    Attributes:
        words: As on the command line.
    """

    @property
    def words(self) -> str:
        """As on the command line."""

    def open(self) -> AbstractContextManager[OpenWorkers]:
        """Have the workers for as long as the context lasts."""


class DriverWorkers:
    """This process does every unit (``--dask none``)."""

    words = "none"

    def open(self) -> AbstractContextManager["DriverWorkers"]:
        """Return what there is already."""
        return nullcontext(self)

    def executor(self, *, here: bool) -> Executor:
        """Do units here, whatever the stage."""
        return InProcess()


def attempt(task: Task, progress: Progress) -> Outcome:
    """Do a task; a failure becomes an outcome."""
    begun = time.monotonic()
    try:
        return do(task, progress)
    except Exception as error:  # Whatever a unit dies of, the others shall go on.
        seconds = time.monotonic() - begun
        return failure(task.unit.name, error, traceback.format_exc(), seconds)


def failure(name: str, error: BaseException, trace: str, seconds: float) -> Outcome:
    """Say in one line, and in full, why a unit failed."""
    line = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(name, None, seconds, line, trace)


def do(task: Task, progress: Progress) -> Outcome:
    """Do a task and publish its folder, manifest last. Safe to repeat after any crash."""
    if (task.target / MANIFEST).is_file():
        return Outcome(task.unit.name, read_manifest(task.target)["report"], 0.0)
    stage = load_stage(task.module)
    started, begun = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
    patience = signals.deferred() if stage.resumes else nullcontext()
    # A stop that finds the work done waits until it has its name: it would be lost.
    with patience, publish(task.target, resume=stage.resumes) as partial:
        report = stage.work(task.unit, partial, task.settings, progress)
        same, varying = split_report(report)
        seconds = time.monotonic() - begun
        write_manifest(
            partial, {**task.about, "report": same}, Run(started, seconds, varying)
        )
    return Outcome(task.unit.name, same, time.monotonic() - begun)
