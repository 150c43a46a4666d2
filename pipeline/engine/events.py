"""What happens in a run, told to a log file and to whoever listens."""

import json
import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pipeline.engine.layout import Root

Event = Mapping[str, Any]
"""``event`` says which; the rest are its figures.

``run-started``, ``stage-cached``, ``stage-started`` (units, made), ``unit-done``,
``unit-failed`` (error, trace), ``finish-started``, ``progress`` (done, total, note; logged
where nothing was for some seconds), ``worker-full`` (worker, memory_gib: restarted, as it
fills its memory), ``worker-lost`` (worker, units that begin again), ``workers-missing``
(timeout_min), ``stage-done`` (report), ``stage-failed``, ``stage-skipped``, ``run-ended``
or ``run-stopped`` (why). Around the runs of a preset: ``leg-started`` (leg, number, legs),
``leg-failed`` (leg, why).
"""

QUIET_S = 5.0
"""How long a log may be silent before progress is told there too, for who watches it."""


@runtime_checkable
class Listener(Protocol):
    """Whoever wants to know, e.g. the screen."""

    def __call__(self, event: Event) -> None:
        """Take note of one event."""


class Events:
    """Tells every event to the listeners, and to a JSON-lines file below ``logs/``."""

    def __init__(self, root: Root, listeners: tuple[Listener, ...] = ()) -> None:
        self.log = root.logs / f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}.jsonl"
        self._listeners = listeners
        self._wrote_at = time.monotonic()

    def emit(self, event: str, **figures: Any) -> None:
        """Tell one event. A line of the log is written whole and at once."""
        about = {"event": event, **figures}
        if event != "progress" or time.monotonic() - self._wrote_at >= QUIET_S:
            self._write(about)
        for listener in self._listeners:
            listener(about)

    def _write(self, about: dict[str, Any]) -> None:
        self.log.parent.mkdir(parents=True, exist_ok=True)
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, **about}, default=str) + "\n"
        _append(self.log, line.encode())
        self._wrote_at = time.monotonic()


def _append(path: Path, data: bytes) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(handle, data)
    finally:
        os.close(handle)
