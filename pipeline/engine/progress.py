"""Progress of a stage: units or steps done, rate, and time left."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pipeline.engine.events import Event

MAX_VALUE_LENGTH = 36
RECENT_S = 120.0
"""Rates are averages over about this time."""
MIN_SAMPLE_S = 1.0
MIN_PROGRESS = 0.05
"""Below this part of a unit no rate is given: starting takes longer than continuing."""


@dataclass
class ProgressMeter:
    """Measures the progress of one stage from its events.

    Every finished unit counts one, and the progress of running units counts as fractions.
    A stage with a single unit (training) is measured in that unit's own steps.

    Attributes:
        stage: Its name.
        units: Number of its units.
        before: Units that were made before this run.
        what: Name of the steps of a single unit.
    """

    stage: str
    units: int
    before: int
    what: str = "steps"
    clock: Callable[[], float] = time.monotonic
    note: str = ""
    finishing: bool = False
    _done: int = 0
    _unit_progress: tuple[float, float] = (0.0, 1.0)
    _first_step: float | None = None
    _samples: deque[tuple[float, float]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        """Start the clock."""
        self._samples.append((self.clock(), 0.0))

    def take(self, event: Event) -> None:
        """Handle an event."""
        if event["event"] in ("unit-done", "unit-failed"):
            self._done += 1
            self._unit_progress, self.note = (0.0, 1.0), ""
        elif event["event"] == "finish-started":
            self.finishing, self._unit_progress, self.note = True, (0.0, 1.0), ""
        elif event["event"] == "progress" and event["total"]:
            self._unit_progress = (float(event["done"]), float(event["total"]))
            self.note = str(event["note"])
            if self._first_step is None:
                self._first_step = self._unit_progress[0]
        self._add_sample()

    def _add_sample(self) -> None:
        """Add a sample of the progress, and drop those too old for the rate."""
        now, marks = self.clock(), self._samples
        if len(marks) > 1 and now - marks[-1][0] < MIN_SAMPLE_S:
            marks[-1] = (marks[-1][0], self._made)
        else:
            marks.append((now, self._made))
        while len(marks) > 2 and now - marks[1][0] > RECENT_S:
            marks.popleft()

    @property
    def in_steps(self) -> bool:
        """Whether progress is measured in the steps of a single unit."""
        return self.units - self.before <= 1 and self._first_step is not None

    @property
    def done(self) -> float:
        """Units, or steps, that are done."""
        if self.finishing:
            return self.total
        if self.in_steps:
            return self._unit_progress[0]
        return min(float(self.units), self.before + self._done + self._fraction)

    @property
    def total(self) -> float:
        """Units, or steps, in all."""
        return self._unit_progress[1] if self.in_steps else float(self.units)

    @property
    def _fraction(self) -> float:
        return self._unit_progress[0] / self._unit_progress[1]

    @property
    def _made(self) -> float:
        """The part of ``done`` that this run did."""
        return self.done - (self._first_step or 0.0 if self.in_steps else self.before)

    @property
    def per_s(self) -> float | None:
        """Units, or steps, per second, lately; None until enough is done."""
        since, before = self._samples[0]
        taken, made = self.clock() - since, self._made - before
        return made / taken if made >= MIN_PROGRESS and taken > 0 else None

    @property
    def remaining_s(self) -> float | None:
        """Seconds left at this rate."""
        rate = self.per_s
        return max(0.0, self.total - self.done) / rate if rate else None

    def words(self) -> str:
        """Format in one line: ``12 of 27 units, 0.8/s, 0:19 left, note``."""
        if self.finishing:
            return self.remark
        what = self.what if self.in_steps else "units"
        parts = [f"{amount(self.done)} of {amount(self.total)} {what}"]
        if self.per_s is not None and self.remaining_s is not None:
            parts += [rate(self.per_s), f"{clock_time(self.remaining_s)} left"]
        return ", ".join([*parts, *self._notes])

    @property
    def remark(self) -> str:
        """Notes besides the numbers."""
        gathering = [f"gathering {self._fraction:.0%}"] if self.finishing else []
        return ", ".join([*gathering, *self._notes])

    @property
    def _notes(self) -> list[str]:
        return [self.note] if self.note else []


def amount(count: float | int) -> str:
    """Format a count: ``1.5``, ``12``, ``20000``."""
    return f"{count:.4g}" if count < 1000 else f"{count:.0f}"


def rate(per_s: float) -> str:
    """Format a rate as ``0.8/s``, or a slow one as ``40 s each``."""
    return f"{per_s:.3g}/s" if per_s >= 0.1 else f"{1 / per_s:.3g} s each"


def clock_time(seconds: float) -> str:
    """Format a duration as ``0:07``, ``12:30`` or ``1:02:03``."""
    minutes, second = divmod(round(seconds), 60)
    hour, minute = divmod(minutes, 60)
    return f"{hour}:{minute:02}:{second:02}" if hour else f"{minute}:{second:02}"


def figures(report: dict[str, Any], most: int = 7) -> str:
    """Format the scalar figures of a report in one line."""
    plain = {
        name: value
        for name, value in report.items()
        if isinstance(value, int | float | str) and not isinstance(value, bool)
    }
    shown = list(plain.items())[:most]
    return ", ".join(f"{name} {_short(value)}" for name, value in shown)


def _short(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[: MAX_VALUE_LENGTH - 3]}..."
