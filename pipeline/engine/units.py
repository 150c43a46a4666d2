"""Doing one unit of work: the same code in the driver's process and on any worker."""

import socket
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pipeline.engine import machine, signals
from pipeline.engine.atomic import MANIFEST, publish
from pipeline.engine.manifest import Run, read_manifest, split_report, write_manifest
from pipeline.engine.registry import load_stage
from pipeline.engine.stage import Progress, Report, Unit


class WorkersLostError(OSError):
    """The workers are gone, and with them the units in flight.

    Finished units are on disk; the next run continues from there.
    """


class DeviceLostError(WorkersLostError):
    """The device of this process failed, and all later work on it would fail too."""


DEVICE_FAILURES = ("CUDA error", "device-side assert", "illegal memory access")
"""Words of errors after which CUDA refuses all later work of a process."""


@dataclass(frozen=True, slots=True)
class Task:
    """A unit as it is sent to a worker: paths and small plain values only.

    Attributes:
        module: Module of the stage's code.
        unit: The unit.
        target: Folder to make.
        settings: The stage's settings.
        about: The manifest without the report.
    """

    module: str
    unit: Unit
    target: Path
    settings: Any
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a unit.

    Attributes:
        name: Name of the unit.
        report: Its figures; None if it failed.
        seconds: Time it took.
        error: Why it failed, in one line.
        trace: Traceback of the failure.
    """

    name: str
    report: Report | None
    seconds: float
    error: str = ""
    trace: str = ""


Tell = Callable[..., None]
"""``tell(event, **figures)`` emits an event about workers."""


@runtime_checkable
class Executor(Protocol):
    """Does tasks and yields the outcome of each."""

    def run(
        self,
        tasks: Sequence[Task],
        may_start: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``may_start()`` is False."""


class InProcess:
    """Does one task after the other in this process."""

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
    """Workers of a run that has begun."""

    def executor(self, *, here: bool) -> Executor:
        """Return the executor of a stage's units; with ``here``, one in this process."""


@runtime_checkable
class Workers(Protocol):
    """Which workers do the units of a run (``--dask``).

    Attributes:
        words: As on the command line.
    """

    @property
    def words(self) -> str:
        """As on the command line."""

    def open(self) -> AbstractContextManager[OpenWorkers]:
        """Start the workers; the context stops them."""


class DriverWorkers:
    """Does every unit in this process (``--dask none``)."""

    words = "none"

    def open(self) -> AbstractContextManager["DriverWorkers"]:
        """Return itself: there is nothing to start."""
        return nullcontext(self)

    def executor(self, *, here: bool) -> Executor:
        """Return an executor in this process, whatever the stage."""
        return InProcess()


def attempt(task: Task, progress: Progress) -> Outcome:
    """Do a task; turn an exception into a failed outcome.

    Raises:
        DeviceLostError: if the device failed: other units would fail on it too.
    """
    begun = time.monotonic()
    try:
        return do(task, progress)
    except Exception as error:  # Other units go on, whatever the error.
        reason = device_failure(error)
        if reason:
            raise _device_lost(task.unit.name, reason) from error
        seconds = time.monotonic() - begun
        return failure(task.unit.name, error, traceback.format_exc(), seconds)


def failure(name: str, error: BaseException, trace: str, seconds: float) -> Outcome:
    """Build the outcome of a failed unit: the error in one line, and its traceback."""
    line = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(name, None, seconds, line, trace)


def device_failure(error: BaseException | None) -> str:
    """Return the first line of the device failure that an error is, or comes from.

    A failed assertion or a bad address in a CUDA kernel leaves a process without its
    device: every later call fails. Errors are told by name, as this package does without
    torch.

    Returns:
        The line; empty if the device is not to blame.
    """
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        words, name = str(error), type(error).__name__
        failed = name == "AcceleratorError" or any(
            each in words for each in DEVICE_FAILURES
        )
        if isinstance(error, RuntimeError) and failed:
            return f"{name}: {words}".splitlines()[0]
        error = error.__cause__ or error.__context__
    return ""


def _device_lost(unit: str, reason: str) -> DeviceLostError:
    devices = ", ".join(machine.describe()["gpus"]) or "unknown"
    return DeviceLostError(
        f"unit {unit}: the device (of {socket.gethostname()}: {devices}) failed, and this "
        f"process can do nothing more on it: {reason}; what is done is kept: run again, "
        "with CUDA_LAUNCH_BLOCKING=1 to see in the log where it happens"
    )


def do(task: Task, progress: Progress) -> Outcome:
    """Do a task and publish its folder, manifest last. May be repeated after any crash."""
    if (task.target / MANIFEST).is_file():
        return Outcome(task.unit.name, read_manifest(task.target)["report"], 0.0)
    stage = load_stage(task.module)
    started, begun = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
    stops = signals.deferred() if stage.resumes else nullcontext()
    # A signal after the work is done waits until the folder is published.
    with stops, publish(task.target, resume=stage.resumes) as partial:
        report = stage.work(task.unit, partial, task.settings, progress)
        same, varying = split_report(report)
        seconds = time.monotonic() - begun
        write_manifest(
            partial, {**task.about, "report": same}, Run(started, seconds, varying)
        )
    return Outcome(task.unit.name, same, time.monotonic() - begun)
