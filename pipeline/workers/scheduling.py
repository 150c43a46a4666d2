"""Scheduling of units on workers that may fail, exceed their memory, or be lost.

At most two tasks per worker thread are submitted at once, so that the scheduler never holds
many. Units that were running when workers died are tried again at the end, one at a time:
this finds the unit that kills its workers, and no other unit fails with it. A unit that
takes longer than a unit may is not tried again after that.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from queue import Empty, SimpleQueue
from typing import Protocol, runtime_checkable

from pipeline.engine.stage import Progress
from pipeline.engine.units import Outcome, Task, Tell, WorkersLostError, failure

RETRIES = 2
"""A unit is retried so often before it counts as failed."""
TASKS_PER_THREAD = 2
S_PER_MINUTE = 60.0
COUNT_WORKERS_EVERY_S = 5.0
"""Workers are counted again after so long."""
NO_WORKER_TIMEOUT_S = 600.0
"""Without any worker for so long, a run gives up."""


@dataclass(frozen=True, slots=True)
class TaskEnded:
    """An attempt of a unit has ended; its result can be taken."""

    name: str


@dataclass(frozen=True, slots=True)
class TaskProgress:
    """Progress of a unit in its own steps."""

    name: str
    done: float
    total: float
    note: str


@dataclass(frozen=True, slots=True)
class WorkerMemoryFull:
    """A worker exceeded its memory limit and is restarted."""

    worker: str
    memory_bytes: int


@dataclass(frozen=True, slots=True)
class WorkerLost:
    """A worker ended; its attempts start again on others."""

    worker: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DeviceFailed:
    """The device of a worker failed during an attempt, and the worker ends."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class TimeLimitExceeded:
    """An attempt took longer than a unit may, and its worker ends."""

    name: str
    limit_s: float


WorkerEvent = (
    TaskEnded
    | TaskProgress
    | WorkerMemoryFull
    | WorkerLost
    | DeviceFailed
    | TimeLimitExceeded
)


@dataclass(frozen=True, slots=True)
class TaskFailure:
    """Why an attempt failed.

    Attributes:
        error: The exception.
        trace: Its traceback.
        killed: Whether several workers in a row died during it.
    """

    error: BaseException
    trace: str
    killed: bool


@runtime_checkable
class WorkerPool(Protocol):
    """Workers that attempts are submitted to."""

    @property
    def inbox(self) -> SimpleQueue[WorkerEvent]:
        """Events of the workers, in order of arrival."""

    def begin(self, name: str, task: Task) -> None:
        """Submit a task as an attempt of that name."""

    def take(self, name: str) -> Outcome | TaskFailure:
        """Return the result of an attempt that has ended.

        Raises:
            WorkersLostError: if the scheduler does not know.
        """

    def threads(self) -> int:
        """Return the number of tasks that run at once.

        Raises:
            WorkersLostError: if there is no answer.
        """


class PoolExecutor:
    """Does tasks on a pool of workers."""

    def __init__(self, pool: WorkerPool) -> None:
        self._crew = pool

    def run(
        self,
        tasks: Sequence[Task],
        may_start: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``may_start()`` is False.

        Raises:
            WorkersLostError: if the pool is lost.
        """
        flow = _Schedule(self._crew, list(reversed(tasks)), progress, tell)
        while flow.begin(may_start):
            outcome = flow.listen()
            if outcome is not None:
                yield outcome
                flow.emit_progress()


@dataclass(slots=True)
class _Schedule:
    """Tasks of one run.

    Attributes:
        pool: The workers.
        waiting: Tasks that are not submitted, the next one last.
        progress: Receives the progress of running units.
        tell: Receives events about workers.
        suspects: Tasks that were running when workers died.
        under_way: Submitted tasks by the names of their attempts.
        progress_of: Their progress.
        window: Largest number of submitted tasks.
    """

    pool: WorkerPool
    waiting: list[Task]
    progress: Progress
    tell: Tell
    suspects: list[Task] = field(default_factory=list)
    under_way: dict[str, Task] = field(default_factory=dict)
    progress_of: dict[str, TaskProgress] = field(default_factory=dict)
    window: int = 1
    _tried_again: set[str] = field(default_factory=set)
    _memory_full: set[str] = field(default_factory=set)
    _filled_memory: set[str] = field(default_factory=set)
    _device_failures: dict[str, str] = field(default_factory=dict)
    _timed_out: dict[str, float] = field(default_factory=dict)
    _counted_at: float = -math.inf
    _workers_seen_at: float = field(default_factory=time.monotonic)
    _workers_missing: bool = False

    def begin(self, may_start: Callable[[], bool]) -> bool:
        """Submit as many tasks as fit; return whether any is submitted."""
        if time.monotonic() - self._counted_at > COUNT_WORKERS_EVERY_S:
            self._count_workers()
        while may_start():
            if self.waiting and len(self.under_way) < self.window:
                self._submit(self.waiting.pop(), "")
            elif self.suspects and not self.waiting and not self.under_way:
                self._submit(self.suspects.pop(0), "-alone")
            else:
                break
        return bool(self.under_way)

    def _submit(self, task: Task, mark: str) -> None:
        name = f"{task.about['stage']}-{task.target.name}{mark}"
        self.under_way[name] = task
        self.pool.begin(name, task)

    def listen(self) -> Outcome | None:
        """Wait for one event; return the outcome of a unit if it ended."""
        try:
            news = self.pool.inbox.get(timeout=COUNT_WORKERS_EVERY_S)
        except Empty:
            return None
        if isinstance(news, TaskEnded):
            return self._end(news.name)
        if isinstance(news, WorkerMemoryFull):
            self._memory_full.add(news.worker)
            memory_gib = round(news.memory_bytes / (1 << 30), 2)
            self.tell("worker-full", worker=news.worker, memory_gib=memory_gib)
        elif isinstance(news, WorkerLost):
            self._emit_worker_lost(news)
        elif isinstance(news, DeviceFailed):
            self._emit_device_failed(news)
        elif isinstance(news, TimeLimitExceeded):
            self._emit_timed_out(news)
        elif news.name in self.under_way:
            self.progress_of[news.name] = news
            self.emit_progress()
        return None

    def _end(self, name: str) -> Outcome | None:
        found, task = self.pool.take(name), self.under_way.pop(name)
        self.progress_of.pop(name, None)
        if isinstance(found, Outcome):
            return found
        unit = task.unit.name
        if found.killed and unit not in self._tried_again | self._timed_out.keys():
            self._tried_again.add(unit)
            self.suspects.append(task)
            return None
        outcome = failure(unit, found.error, found.trace, 0.0)
        why = self._cause(unit, killed=found.killed)
        return replace(outcome, error=f"{outcome.error} ({why})") if why else outcome

    def _cause(self, unit: str, *, killed: bool) -> str:
        """Say why the workers of a failed unit ended; empty where that is not known."""
        if unit in self._filled_memory:
            return "a worker that did it filled its memory"
        if killed and unit in self._device_failures:
            return f"it failed the device of its workers: {self._device_failures[unit]}"
        if killed and unit in self._timed_out:
            limit_min = self._timed_out[unit] / S_PER_MINUTE
            return f"it took longer than --unit-timeout, {limit_min:g} minutes"
        return ""

    def _emit_device_failed(self, news: DeviceFailed) -> None:
        if news.name in self.under_way:
            unit = self.under_way[news.name].unit.name
            self._device_failures[unit] = news.reason
            self.tell("device-failed", unit=unit, reason=news.reason)

    def _emit_timed_out(self, news: TimeLimitExceeded) -> None:
        if news.name in self.under_way:
            unit = self.under_way[news.name].unit.name
            self._timed_out[unit] = news.limit_s
            self.tell("unit-timeout", unit=unit, limit_min=news.limit_s / S_PER_MINUTE)

    def _emit_worker_lost(self, news: WorkerLost) -> None:
        names = [name for name in news.names if name in self.under_way]
        for name in names:
            self.progress_of.pop(name, None)
        units = sorted(self.under_way[name].unit.name for name in names)
        if news.worker in self._memory_full:
            self._filled_memory.update(units)
        self.tell("worker-lost", worker=news.worker, units=units)

    def _count_workers(self) -> None:
        """Count the workers: a cluster may grow and shrink."""
        threads, now = self.pool.threads(), time.monotonic()
        self._counted_at = now
        self._workers_seen_at = now if threads else self._workers_seen_at
        if now - self._workers_seen_at > NO_WORKER_TIMEOUT_S:
            raise WorkersLostError(
                f"no worker for {NO_WORKER_TIMEOUT_S / 60:g} minutes; what is done is "
                "kept: start workers and run again"
            )
        if not threads and not self._workers_missing:
            self.tell("workers-missing", timeout_min=NO_WORKER_TIMEOUT_S / 60)
        self._workers_missing = not threads
        self.window = max(1, threads * TASKS_PER_THREAD)

    def emit_progress(self) -> None:
        """Report the progress of all running units as one sum."""
        progress_of = [share for share in self.progress_of.values() if share.total]
        if len(progress_of) == 1:
            self.progress(progress_of[0].done, progress_of[0].total, progress_of[0].note)
        elif progress_of:
            done = sum(min(1.0, share.done / share.total) for share in progress_of)
            note = f"{len(progress_of)} at a time, one of them: {progress_of[-1].note}"
            self.progress(done, 1.0, note if progress_of[-1].note else "")
