"""The door to the terminal: progress while a run goes on, and tables.

With a terminal there is a bar per stage; without one, a plain line per event, and while a
stage goes on one line every ten seconds.
"""

import sys
import time
from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table
from rich.text import Text

from pipeline.engine.events import Event
from pipeline.engine.progress import ProgressMeter, figures

QUIET_S = 10.0
PLAIN_WIDTH = 160


def console(*, stderr: bool = False) -> Console:
    """Standard output (or error); as wide as a log may be where it is no terminal."""
    plain = Console(stderr=stderr)
    return plain if plain.is_terminal else Console(stderr=stderr, width=PLAIN_WIDTH)


def show_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table to standard output."""
    console().print(_table(title, columns, rows))


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    wide = min(len(title), console().width)  # Or the title would be broken up.
    table = Table(*columns, title=title, title_justify="left", min_width=wide)
    for row in rows:
        table.add_row(*[_cell(value) for value in row])
    return table


def gibibytes(count: int) -> str:
    """Write a number of bytes for people."""
    return f"{count / (1 << 30):.2f} GiB" if count >= 1 << 30 else f"{count / 1e6:.1f} MB"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("[", r"\[")


class LiveTable:
    """A table on standard output that changes in place.

    Without a terminal there are lines: at once where a state changes, and else, of what
    changes, one every ten seconds.

    Attributes:
        alive: Whether there is a terminal to draw on.
    """

    def __init__(self) -> None:
        self._console = console()
        self.alive = self._console.is_terminal
        self._live: Live | None = None
        self._said: dict[str, tuple[float, str, str]] = {}

    def __enter__(self) -> "LiveTable":
        if self.alive:
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def draw(
        self, title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], words: str
    ) -> None:
        """Show a table, and words below it, in the place of what was shown before."""
        if self._live is None:
            return
        table = Table(
            title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0)
        )
        cells = [[_cell(value) for value in row] for row in rows]
        for place, name in enumerate(columns):
            widest = max([len(name), *(len(row[place]) for row in cells)])
            last = place == len(columns) - 1  # Where it is narrow, this one is cut.
            table.add_column(name, no_wrap=True, min_width=None if last else widest)
        for row in cells:
            table.add_row(*row)
        self._live.update(Group(table, Text(words)), refresh=True)

    def tell(self, name: str, state: str, words: str) -> None:
        """Say how one thing stands, in a line; nothing if there is no news worth it."""
        said_at, said_state, said = self._said.get(name, (-QUIET_S, "", ""))
        now = time.monotonic()
        if words == said or (state == said_state and now - said_at < QUIET_S):
            return
        self._said[name] = (now, state, words)
        if words:
            line = f"{name}: {words}" if name else words
            sys.stdout.write(f"{time.strftime('%H:%M:%S')} {line}\n")
            sys.stdout.flush()


class Screen:
    """Listens to a run and shows it on standard error."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._gauge: ProgressMeter | None = None
        self._bars: Progress | None = None
        self._bar: TaskID | None = None
        self._said_at = time.monotonic()

    def __enter__(self) -> "Screen":
        if self._console.is_terminal:
            self._bars = Progress(
                TextColumn("{task.description:<12}"),
                BarColumn(),
                TextColumn("{task.fields[words]}"),
                console=self._console,
            )
            self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, event: Event) -> None:
        """Show one event."""
        kind = event["event"]
        if kind in ("stage-started", "work-started"):
            self._start(event)
        elif kind in _STEPS and self._gauge is not None:
            self._gauge.take(event)
            self._go_on(event)
        if kind in _LINES:
            self._say(_LINES[kind].format_map(_Words(event)))

    def _start(self, event: Event) -> None:
        what = event.get("what", "steps")
        self._gauge = ProgressMeter(event["stage"], event["units"], event["made"], what)
        self._said_at = time.monotonic()
        if self._bars is not None:
            self._bar = self._bars.add_task(event["stage"], total=None, words="")

    def _go_on(self, event: Event) -> None:
        meter = self._gauge
        if meter is None:
            return
        if self._bars is not None and self._bar is not None:
            self._bars.update(
                self._bar, completed=meter.done, total=meter.total, words=meter.words()
            )
        elif time.monotonic() - self._said_at >= QUIET_S:
            self._said_at = time.monotonic()
            self._say(f"{meter.stage}: {meter.words()}")

    def _say(self, line: str) -> None:
        if self._bars is None:
            sys.stderr.write(f"{time.strftime('%H:%M:%S')} {line}\n")
            sys.stderr.flush()
        else:
            self._console.print(line, markup=False, highlight=False)


_STEPS = ("unit-done", "unit-failed", "finish-started", "progress")
_LINES = {
    "stage-cached": "{stage}: cached ({units} units)",
    "stage-started": "{stage}: {units} units, {made} of them made before",
    "unit-failed": "{stage}: unit {unit} failed: {error}",
    "worker-full": "{stage}: worker {worker} is restarted, as it fills its memory "
    "({memory_gib} GiB)",
    "worker-lost": "{stage}: worker {worker} is lost; what it had under way begins again",
    "device-failed": "{stage}: a worker is restarted, as its device failed in unit {unit}: "
    "{reason}",
    "unit-timeout": "{stage}: a worker is restarted, as unit {unit} took longer than "
    "{limit_min:g} minutes",
    "workers-missing": "{stage}: there are no workers; waiting {timeout_min:g} minutes "
    "for one",
    "stage-done": "{stage}: made; {figures}",
    "stage-failed": "{stage}: failed; the log says more, and the next run tries again",
    "stage-skipped": "{stage}: skipped, as what it needs is not made",
    "arm-run-started": "{arm_run} (run {number} of {arm_runs})",
    "arm-run-failed": "{arm_run}: {why}",
}


class _Words(dict[str, Any]):
    """The figures of an event, with its report in words."""

    def __init__(self, event: Event) -> None:
        super().__init__(event)
        self["figures"] = figures(event.get("report") or {}) or "no figures"
