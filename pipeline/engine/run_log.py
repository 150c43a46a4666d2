"""The state of a run, read from its log while the run goes on."""

import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from pipeline.engine.events import Event
from pipeline.engine.progress import ProgressMeter


class LogTail:
    """Reads the lines of a log that are new since the last read.

    An incomplete last line is left for the next read; a damaged line is skipped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._offset = 0

    def read(self) -> Iterator[dict[str, Any]]:
        """Yield the new events; none if the log does not exist."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.splitlines():
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                yield event


class RunLog:
    """Follows one run: its current stage, progress, rate and failures.

    Attributes:
        workers: Value of ``--dask``.
        stage: The stage that is being made; empty between stages.
        meter: Progress of that stage.
        failed: Units of that stage that failed in this run.
    """

    def __init__(self, path: Path) -> None:
        self._tail = LogTail(path)
        self._now_s = 0.0
        self.workers = "none"
        self.stage = ""
        self.meter: ProgressMeter | None = None
        self.failed = 0

    def follow(self, now_s: float) -> None:
        """Read new events; rates are then as of ``now_s`` (seconds of the epoch)."""
        for event in self._tail.read():
            self._now_s = _time_s(event, self._now_s)
            self._take(event)
        # Clocks of two machines may differ; time must not run backwards.
        self._now_s = max(now_s, self._now_s)

    def _take(self, event: Event) -> None:
        kind = event["event"]
        if kind == "run-started":
            self.workers = str(event.get("workers", self.workers))
        elif kind == "stage-started":
            self.stage, self.failed = str(event["stage"]), 0
            units, made = int(event["units"]), int(event["made"])
            self.meter = ProgressMeter(self.stage, units, made, clock=lambda: self._now_s)
        elif kind in _ENDS:
            self.stage, self.meter = "", None
        elif self.meter is not None:
            self.failed += kind == "unit-failed"
            self.meter.take(event)


_ENDS = ("stage-done", "stage-failed", "run-ended", "run-stopped")


def _time_s(event: Event, otherwise: float) -> float:
    try:
        return datetime.fromisoformat(str(event["time"])).timestamp()
    except (KeyError, ValueError):
        return otherwise
