"""Units of work done one after the other in this process, each measured."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.engine.stage import Progress
from pipeline.engine.units import Outcome, Task, Tell, attempt


@dataclass(frozen=True, slots=True)
class MeasuredUnit:
    """One unit of work, measured.

    Attributes:
        name: Its name.
        seconds: That it used.
        marks: The same, so far, whenever it reported progress.
        done: What it reported each time.
        folder: What it wrote.
        report: What it reported.
    """

    name: str
    seconds: float
    marks: tuple[float, ...]
    done: tuple[float, ...]
    folder: Path
    report: Mapping[str, Any]


@dataclass(slots=True)
class MeasuredWorkers:
    """Workers in this process that measure every unit.

    Attributes:
        by_clock: Whether seconds are those of the clock.
        samples: Measured units by stage.
    """

    by_clock: bool
    samples: dict[str, list[MeasuredUnit]] = field(default_factory=dict)
    words: str = "none"

    def open(self) -> AbstractContextManager["MeasuredWorkers"]:
        """Start nothing."""
        return nullcontext(self)

    def executor(self, *, here: bool) -> "MeasuredWorkers":
        """Do everything here."""
        return self

    def run(
        self,
        tasks: Sequence[Task],
        may_start: Callable[[], bool],
        progress: Progress,
        tell: Tell,
    ) -> Iterator[Outcome]:
        """Do all tasks, and measure each; begin no more once ``may_start()`` is False."""
        for task in tasks:
            if not may_start():
                return
            yield self._measure(task)

    def _measure(self, task: Task) -> Outcome:
        marks: list[float] = []
        reported: list[float] = []
        begun = self._now()

        def mark(done: float | int, total: float | int, note: str = "") -> None:
            marks.append(self._now() - begun)
            reported.append(float(done))

        outcome = attempt(task, mark)
        seconds = self._now() - begun
        if outcome.report is not None:
            times = (seconds, tuple(marks), tuple(reported))
            sample = MeasuredUnit(task.unit.name, *times, task.target, outcome.report)
            self.samples.setdefault(str(task.about["stage"]), []).append(sample)
        return outcome

    def _now(self) -> float:
        return time.perf_counter() if self.by_clock else time.process_time()
