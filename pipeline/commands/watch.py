"""A root seen from another terminal, again and again, while pipelines run in it.

Reads files only: locks, attempts, manifests, the logs of runs. Whatever appears or goes
while it looks is seen by the next look.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from socket import gethostname
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.atomic import MANIFEST, PARTIAL, StoreError
from pipeline.engine.layout import KEY_DIGITS, Root, read_json
from pipeline.engine.locks import holder
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import PlanError
from pipeline.engine.run_log import RunLog
from pipeline.engine.status import StageStatus, stage_statuses
from pipeline.settings.request import LAST, Request
from pipeline.workers.processes import memory_bytes

QUARANTINED = "quarantined"
"""Figure of a report that counts what was set aside."""
NOTHING_YET = "nothing was run here yet"


@dataclass(frozen=True, slots=True)
class Row:
    """One stage as it stands at one moment.

    Attributes:
        stage: Its name.
        state: As of ``status``.
        units: Units of its work, or steps of its only unit; None where that is not known.
        done: How many of them are done, in part counting in part.
        what: ``units``, or what the steps are.
        per_s: Units or steps a second of late; None where nothing was done yet.
        remaining_s: Seconds to go at this rate.
        memory_bytes: Of the run's process and all below it; None if it runs elsewhere.
        at_work: Units under way.
        quarantined: Records set aside; None in a stage that sets none aside.
        failed: Units that failed, in this run or, when it is over, in the last one.
        run: The run that makes it: process, host, start, workers; empty if there is none.
        note: What the work says of itself, or why the stage stands as it does.
    """

    stage: str
    state: str
    units: float | int | None
    done: float | int | None
    what: str
    per_s: float | None
    remaining_s: float | None
    memory_bytes: int | None
    at_work: int
    quarantined: int | None
    failed: int
    run: str
    note: str


@dataclass(frozen=True, slots=True)
class RootSnapshot:
    """All stages at one moment.

    Attributes:
        time_s: When, in seconds of the epoch.
        rows: A row per stage; as they were last where this look failed.
        trouble: Why it failed, or why there are no rows; empty if all is well.
    """

    time_s: float
    rows: tuple[Row, ...]
    trouble: str

    @property
    def running(self) -> bool:
        """Whether any stage is being made."""
        return any(row.state == "running" for row in self.rows)


class Watcher:
    """Takes snapshots of a root.

    Args:
        ask: Returns the request; read anew each time, as another run may change it.
        environ: For ``stages.yaml``.
    """

    def __init__(
        self,
        ask: Callable[[], Request],
        environ: Mapping[str, str],
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._ask, self._environ, self._clock = ask, environ, clock
        self._rows: tuple[Row, ...] | None = None
        self._runs: dict[Path, RunLog] = {}
        self._set_aside: dict[Path, int | None] = {}

    def look(self) -> RootSnapshot:
        """See how all stages stand.

        Raises:
            ConfigError: if the first look finds wrong words or settings.
            PlanError: if it finds that the stages cannot be.
        """
        trouble = ""
        try:
            self._rows = self._see(self._ask())
        except (StoreError, OSError) as error:
            trouble = str(error)
        except (ConfigError, PlanError) as error:
            if self._rows is None:
                raise
            trouble = str(error)
        if not self._rows and not trouble:
            trouble = NOTHING_YET
        return RootSnapshot(self._clock(), self._rows or (), trouble)

    def _see(self, request: Request) -> tuple[Row, ...]:
        named = request.records or request.profile
        if not named and not (request.root.refs / LAST).exists():
            return ()
        found = stage_statuses(request.plan([], self._environ), request.made())
        return tuple(self._row(request.root, each) for each in found)

    def _row(self, root: Root, stage_status: StageStatus) -> Row:
        attempt = _attempt(root, stage_status.stage)
        keys = _keys(attempt)
        if stage_status.state == "running":
            return self._running(root, stage_status, keys)
        mine = attempt.get("key") == stage_status.key
        return Row(
            stage=stage_status.stage,
            state=stage_status.state,
            units=stage_status.units,
            done=stage_status.made,
            what="units",
            per_s=None,
            remaining_s=None,
            memory_bytes=None,
            at_work=0,
            quarantined=self._count_set_aside(root, stage_status, keys if mine else {}),
            failed=len(attempt.get("failed", {})) if mine else 0,
            run="",
            note=stage_status.why,
        )

    def _running(
        self, root: Root, stage_status: StageStatus, keys: Mapping[str, str]
    ) -> Row:
        about = holder(root.lock(stage_status.stage))
        log = self._follow(root, about.get("pid"))
        meter = log.meter if log and log.stage == stage_status.stage else None
        here = about.get("host") == gethostname()
        return Row(
            stage=stage_status.stage,
            state=stage_status.state,
            units=meter.total if meter else stage_status.units,
            done=meter.done if meter else stage_status.made,
            what=meter.what if meter and meter.in_steps else "units",
            per_s=meter.per_s if meter else None,
            remaining_s=meter.remaining_s if meter else None,
            memory_bytes=memory_bytes(about["pid"]) if here else None,
            at_work=_count_at_work(root, stage_status.stage, keys),
            quarantined=self._count_set_aside(root, stage_status, keys),
            failed=log.failed if log and meter else 0,
            run=_who(about, log),
            note=meter.remark if meter else "",
        )

    def _follow(self, root: Root, pid: object) -> RunLog | None:
        """Read on in the newest log of a process; process numbers come again."""
        logs = sorted(root.logs.glob(f"*-{pid}.jsonl"))
        if not logs:
            return None
        run = self._runs.setdefault(logs[-1], RunLog(logs[-1]))
        run.follow(self._clock())
        return run

    def _count_set_aside(
        self, root: Root, stage_status: StageStatus, keys: Mapping[str, str]
    ) -> int | None:
        """Count records set aside: by the whole stage, or by the units made so far."""
        folders = [root.unit(stage_status.stage, key) for key in keys.values()]
        if stage_status.state == "cached":
            folders = [root.folder(stage_status.stage, stage_status.key)]
        counts = [self._set_aside_by(folder) for folder in folders]
        known = [count for count in counts if count is not None]
        return sum(known) if known else None

    def _set_aside_by(self, folder: Path) -> int | None:
        """What a made folder reports; manifests never change, so each is read once."""
        if not (folder / MANIFEST).is_file():
            return None
        if folder not in self._set_aside:
            try:
                report = read_manifest(folder)["report"]
            except StoreError:  # It has just been removed.
                return None
            self._set_aside[folder] = report.get(QUARANTINED)
        return self._set_aside[folder]


def _attempt(root: Root, stage: str) -> dict[str, Any]:
    try:
        attempt = read_json(root.attempt(stage))
    except StoreError:  # None, or it has just been made.
        return {}
    return attempt if isinstance(attempt, dict) else {}


def _keys(attempt: Mapping[str, Any]) -> Mapping[str, str]:
    """Keys of the units that a try is about, by name."""
    units = attempt.get("units")
    return units if isinstance(units, dict) else {}


def _count_at_work(root: Root, stage: str, keys: Mapping[str, str]) -> int:
    """Count units whose folder is being written."""
    about = {key[:KEY_DIGITS] for key in keys.values()}
    begun = {path.name[:KEY_DIGITS] for path in root.units(stage).glob(f"*{PARTIAL}")}
    return len(about & begun)


def _who(about: Mapping[str, Any], log: RunLog | None) -> str:
    if not about:
        return ""
    who = f"process {about.get('pid')} on {about.get('host')} since {about.get('since')}"
    return f"{who}, workers {log.workers}" if log else who
