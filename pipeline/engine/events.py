"""Events of a run, written to a log file and passed to listeners."""

import json
import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pipeline.engine.atomic import naming_refusals
from pipeline.engine.layout import Root

Event = Mapping[str, Any]
"""``event`` is its name; the other entries are its figures.

- ``run-started``, ``run-ended``, ``run-stopped`` (why)
- ``stage-cached``, ``stage-started`` (units, made), ``stage-done`` (report),
  ``stage-failed``, ``stage-skipped``
- ``unit-done``, ``unit-failed`` (error, trace), ``finish-started``
- ``progress`` (done, total, note): logged only after some seconds without another event
- ``worker-full`` (worker, memory_gib): restarted, as it exceeds its memory;
  ``worker-lost`` (worker, units that start again); ``workers-missing`` (timeout_min);
  ``device-failed`` (unit, reason), ``unit-timeout`` (unit, limit_min): its worker restarts
- around the runs of a preset: ``arm-run-started`` (arm_run, number, arm_runs),
``arm-run-failed`` (arm_run,
  why)
"""

QUIET_S = 5.0
"""Progress is logged after so long without another event, for ``infgen status --watch``."""


@runtime_checkable
class Listener(Protocol):
    """Receives events, e.g. the screen."""

    def __call__(self, event: Event) -> None:
        """Handle one event."""


class Events:
    """Passes every event to the listeners and appends it to a log in ``logs/``."""

    def __init__(self, root: Root, listeners: tuple[Listener, ...] = ()) -> None:
        self.log = root.logs / f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}.jsonl"
        self._listeners = listeners
        self._wrote_at = time.monotonic()

    def emit(self, event: str, **figures: Any) -> None:
        """Emit one event. Each line of the log is one write."""
        about = {"event": event, **figures}
        if event != "progress" or time.monotonic() - self._wrote_at >= QUIET_S:
            self._write(about)
        for listener in self._listeners:
            listener(about)

    def _write(self, about: dict[str, Any]) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, **about}, default=str) + "\n"
        with naming_refusals(self.log):
            self.log.parent.mkdir(parents=True, exist_ok=True)
            _append(self.log, line.encode())
        self._wrote_at = time.monotonic()


def _append(path: Path, data: bytes) -> None:
    """Append a line, whole or not at all: a nearly full disk takes only a part of it."""
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    before = os.fstat(handle).st_size
    try:
        while data:
            data = data[os.write(handle, data) :]
    except OSError:
        os.ftruncate(handle, before)
        raise
    finally:
        os.close(handle)
