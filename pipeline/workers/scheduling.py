"""Which unit is done when, by workers that may fail, fill their memory, or be lost.

At most two tasks per worker thread are on their way at once, so that whoever hands them out
never holds many. Who was there when workers died is tried again in the end, alone: so the
unit that kills its workers is found, and no other fails with it.
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
"""A unit that fails is tried so often again before it counts as failed."""
TASKS_PER_THREAD = 2
LOOK_S = 5.0
"""Without news for so long, the crew is asked how many it still is."""
NOBODY_S = 600.0
"""Without any worker for so long, a run gives up."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A try of a unit has come to its end: take what became of it."""

    name: str


@dataclass(frozen=True, slots=True)
class Share:
    """How far a unit is, in its own steps."""

    name: str
    done: float
    total: float
    note: str


@dataclass(frozen=True, slots=True)
class Full:
    """A worker used more memory than it may, and is restarted."""

    worker: str
    memory_bytes: int


@dataclass(frozen=True, slots=True)
class Lost:
    """A worker ended; the tries it had begin again on others."""

    worker: str
    names: tuple[str, ...]


News = Ended | Share | Full | Lost


@dataclass(frozen=True, slots=True)
class Broken:
    """Why a try came to nothing.

    Attributes:
        error: The reason.
        trace: Where it was.
        killed: Whether workers died while they were at it, several in a row.
    """

    error: BaseException
    trace: str
    killed: bool


@runtime_checkable
class Crew(Protocol):
    """Workers, wherever they are."""

    @property
    def inbox(self) -> SimpleQueue[News]:
        """What they report, as it comes in."""

    def begin(self, name: str, task: Task) -> None:
        """Hand out a task as a try of that name."""

    def take(self, name: str) -> Outcome | Broken:
        """Return what became of a try that has ended.

        Raises:
            WorkersLostError: if nobody can tell.
        """

    def threads(self) -> int:
        """Count how many tasks they can do at once.

        Raises:
            WorkersLostError: if there is no answer.
        """


class ByCrew:
    """Does tasks by a crew of workers."""

    def __init__(self, crew: Crew) -> None:
        self._crew = crew

    def run(
        self,
        tasks: Sequence[Task],
        go_on: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``go_on()`` is False.

        Raises:
            WorkersLostError: if the crew is lost.
        """
        flow = _Flow(self._crew, list(reversed(tasks)), progress, tell)
        while flow.begin(go_on):
            outcome = flow.listen()
            if outcome is not None:
                yield outcome
                flow.tell_progress()


@dataclass(slots=True)
class _Flow:
    """Tasks on their way.

    Attributes:
        crew: Who does them.
        waiting: Those not begun, the next one last.
        progress: Is told how far the units under way are.
        tell: Is told of lost workers.
        suspects: Those that workers died of, or beside.
        under_way: By the names of their tries.
        shares: How far they are.
        window: How many may be under way.
    """

    crew: Crew
    waiting: list[Task]
    progress: Progress
    tell: Tell
    suspects: list[Task] = field(default_factory=list)
    under_way: dict[str, Task] = field(default_factory=dict)
    shares: dict[str, Share] = field(default_factory=dict)
    window: int = 1
    _tried: set[str] = field(default_factory=set)
    _full: set[str] = field(default_factory=set)
    _filling: set[str] = field(default_factory=set)
    _looked: float = -math.inf
    _manned: float = field(default_factory=time.monotonic)
    _missed: bool = False

    def begin(self, go_on: Callable[[], bool]) -> bool:
        """Hand out as many tasks as fit; tell whether any is under way."""
        if time.monotonic() - self._looked > LOOK_S:
            self._look()
        while go_on():
            if self.waiting and len(self.under_way) < self.window:
                self._hand_out(self.waiting.pop(), "")
            elif self.suspects and not self.waiting and not self.under_way:
                self._hand_out(self.suspects.pop(0), "-alone")
            else:
                break
        return bool(self.under_way)

    def _hand_out(self, task: Task, mark: str) -> None:
        name = f"{task.about['stage']}-{task.target.name}{mark}"
        self.under_way[name] = task
        self.crew.begin(name, task)

    def listen(self) -> Outcome | None:
        """Wait for one piece of news; return a unit's outcome if it was that."""
        try:
            news = self.crew.inbox.get(timeout=LOOK_S)
        except Empty:
            return None
        if isinstance(news, Ended):
            return self._end(news.name)
        if isinstance(news, Full):
            self._full.add(news.worker)
            memory_gib = round(news.memory_bytes / (1 << 30), 2)
            self.tell("worker-full", worker=news.worker, memory_gib=memory_gib)
        elif isinstance(news, Lost):
            self._tell_lost(news)
        elif news.name in self.under_way:
            self.shares[news.name] = news
            self.tell_progress()
        return None

    def _end(self, name: str) -> Outcome | None:
        found, task = self.crew.take(name), self.under_way.pop(name)
        self.shares.pop(name, None)
        if isinstance(found, Outcome):
            return found
        if found.killed and task.unit.name not in self._tried:
            self._tried.add(task.unit.name)
            self.suspects.append(task)
            return None
        outcome = failure(task.unit.name, found.error, found.trace, 0.0)
        if task.unit.name in self._filling:
            more = f"{outcome.error} (a worker that did it filled its memory)"
            return replace(outcome, error=more)
        return outcome

    def _tell_lost(self, news: Lost) -> None:
        names = [name for name in news.names if name in self.under_way]
        for name in names:
            self.shares.pop(name, None)
        units = sorted(self.under_way[name].unit.name for name in names)
        if news.worker in self._full:
            self._filling.update(units)
        self.tell("worker-lost", worker=news.worker, units=units)

    def _look(self) -> None:
        """See how many there are: a cluster may grow and shrink meanwhile."""
        threads, now = self.crew.threads(), time.monotonic()
        self._looked = now
        self._manned = now if threads else self._manned
        if now - self._manned > NOBODY_S:
            raise WorkersLostError(
                f"no worker for {NOBODY_S / 60:g} minutes; what is done is kept: start "
                "workers and run again"
            )
        if not threads and not self._missed:
            self.tell("workers-missing", patience_min=NOBODY_S / 60)
        self._missed = not threads
        self.window = max(1, threads * TASKS_PER_THREAD)

    def tell_progress(self) -> None:
        """Tell how far the units under way are, as one sum."""
        shares = [share for share in self.shares.values() if share.total]
        if len(shares) == 1:
            self.progress(shares[0].done, shares[0].total, shares[0].note)
        elif shares:
            done = sum(min(1.0, share.done / share.total) for share in shares)
            note = f"{len(shares)} at a time, one of them: {shares[-1].note}"
            self.progress(done, 1.0, note if shares[-1].note else "")
