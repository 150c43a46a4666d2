"""Making stages: finished units and stages are kept, missing ones are made.

A kill at any time loses the units in flight at most. A unit's files are synced before its
folder gets its final name, and the stage's folder gets its name after all its units. The
next run removes other folders or continues from them.
"""

import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pipeline.engine import signals
from pipeline.engine.atomic import (
    MANIFEST,
    PARTIAL,
    naming_refusals,
    publish,
    remove_folder,
    write_json,
)
from pipeline.engine.events import Events
from pipeline.engine.inputs import FinishedInputs, finished_units
from pipeline.engine.layout import KEY_DIGITS, Root
from pipeline.engine.locks import LockedError, locked
from pipeline.engine.manifest import (
    Run,
    read_manifest,
    split_report,
    write_manifest,
)
from pipeline.engine.plan import Plan, PlannedStage
from pipeline.engine.progress import figures
from pipeline.engine.stage import FinishedUnit, Progress, Report
from pipeline.engine.status import code_differs
from pipeline.engine.tasks import make_tasks, stage_manifest
from pipeline.engine.units import (
    DriverWorkers,
    OpenWorkers,
    Outcome,
    Task,
    Workers,
    WorkersLostError,
    failure,
)

FINISH = "finish"
"""Name of a stage's ``finish`` among its failed units."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """How to run. No option changes the bytes of results.

    Attributes:
        force: Stages to make again even if they are finished.
        keep_going: After a failed unit, do the other units, and the stages that do not
            depend on it.
        wait: Wait for a run that holds a lock.
        strict_code: Make again what was made by different code.
        workers: Where the units are done (``--dask``).
    """

    force: frozenset[str] = frozenset()
    keep_going: bool = False
    wait: bool = False
    strict_code: bool = False
    workers: Workers = field(default_factory=DriverWorkers)


@dataclass(frozen=True, slots=True)
class StageResult:
    """Result of one stage.

    Attributes:
        stage: Its name.
        state: ``skipped`` where a stage it depends on failed.
        key: Its key.
        units: Number of its units.
        made: Number of units that this run made.
        seconds: Time it took.
        report: Its figures.
        errors: One line per failed unit, by name.
    """

    stage: str
    state: Literal["cached", "made", "failed", "skipped"]
    key: str
    units: int = 0
    made: int = 0
    seconds: float = 0.0
    report: Report = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """Its main figures in one line."""
        return figures(self.report)


def run(plan: Plan, run_options: RunOptions, events: Events) -> list[StageResult]:
    """Make every planned stage that is not finished, each after those it reads.

    Raises:
        LockedError: if another run is making one of them.
        PlanError: if a stage breaks its contract.
        StoreError: if what a stage should read is damaged.
        WorkersLostError: if the workers are gone, and the units in flight with them.
    """
    events.emit("run-started", stages=list(plan.stages), workers=run_options.workers.words)
    try:
        results = _make_stages(plan, run_options, events)
    except (signals.Stopped, LockedError, WorkersLostError) as error:
        events.emit("run-stopped", why=str(error))
        raise
    failed = [result.stage for result in results if result.state == "failed"]
    events.emit("run-ended", failed=failed)
    return results


def _make_stages(plan: Plan, run_options: RunOptions, events: Events) -> list[StageResult]:
    force = plan.after(run_options.force | _made_with_other_code(plan, run_options))
    results: list[StageResult] = []
    with run_options.workers.open() as workers:
        for planned in plan.stages.values():
            unmet = {result.stage for result in results if result.state in _NOT_MADE}
            if unmet and (not run_options.keep_going or unmet & planned.inputs.keys()):
                results.append(StageResult(planned.name, "skipped", planned.key))
                events.emit("stage-skipped", stage=planned.name)
                continue
            making = _StageRun(plan, planned, run_options, events, planned.name in force)
            results.append(making.find_or_make(workers))
    return results


_NOT_MADE = ("failed", "skipped")


def _made_with_other_code(plan: Plan, run_options: RunOptions) -> frozenset[str]:
    if not run_options.strict_code:
        return frozenset()
    return frozenset(name for name in plan.stages if code_differs(plan, name))


@dataclass(frozen=True, slots=True)
class _StageRun:
    """Making one stage."""

    plan: Plan
    planned: PlannedStage
    run_options: RunOptions
    events: Events
    forced: bool

    @property
    def root(self) -> Root:
        return self.plan.root

    @property
    def name(self) -> str:
        return self.planned.name

    @property
    def folder(self) -> Path:
        return self.root.folder(self.name, self.planned.key)

    def find_or_make(self, workers: OpenWorkers) -> StageResult:
        """Return the finished stage, or make it while holding its lock."""
        begun = time.monotonic()
        if self._is_whole():
            return self._cached()
        with locked(self.root.lock(self.name), wait=self.run_options.wait):
            if self._is_whole():
                return self._cached()
            result = self._make(workers)
        taken = time.monotonic() - begun
        return replace(result, seconds=round(taken, 3))

    def _is_whole(self) -> bool:
        return not self.forced and self.root.is_finished(self.name, self.planned.key)

    def _cached(self) -> StageResult:
        manifest = read_manifest(self.folder)
        self.root.point(self.name, self.planned.key)
        units = len(manifest["units"])
        self.events.emit("stage-cached", stage=self.name, units=units)
        report = manifest["report"]
        return StageResult(self.name, "cached", self.planned.key, units, report=report)

    def _make(self, workers: OpenWorkers) -> StageResult:
        inputs = FinishedInputs(self.root, self.planned)
        units = self.planned.stage.plan(inputs, self.planned.settings)
        tasks = make_tasks(self.root, self.planned, units)
        if self.forced:
            self._remove_outputs(tasks)
        self._remove_leftovers()
        todo = [task for task in tasks if not (task.target / MANIFEST).is_file()]
        self._write_attempt(tasks, {})
        self.events.emit(
            "stage-started",
            stage=self.name,
            key=self.planned.key,
            units=len(tasks),
            made=len(tasks) - len(todo),
        )
        outcomes = self._do(todo, workers)
        errors = {outcome.name: outcome.error for outcome in outcomes if outcome.error}
        report: Report = {}
        if not errors:
            self._remove_leftovers()  # Also of workers that died.
            report, errors = self._finish(inputs, tasks)
        self._write_attempt(tasks, errors)
        made = sum(outcome.report is not None for outcome in outcomes)
        if errors:
            self.events.emit("stage-failed", stage=self.name, errors=errors)
            state: Literal["made", "failed"] = "failed"
        else:
            self.root.attempt(self.name).unlink()
            self.root.point(self.name, self.planned.key)
            self.events.emit("stage-done", stage=self.name, report=report)
            state = "made"
        return StageResult(
            self.name, state, self.planned.key, len(tasks), made, 0.0, report, errors
        )

    def _do(self, todo: Sequence[Task], workers: OpenWorkers) -> list[Outcome]:
        outcomes: list[Outcome] = []
        if not todo:
            return outcomes

        def may_start() -> bool:
            return self.run_options.keep_going or not any(
                outcome.error for outcome in outcomes
            )

        units = self.root.units(self.name)
        with naming_refusals(units):
            units.mkdir(parents=True, exist_ok=True)
        executor = workers.executor(here=self.planned.stage.in_driver)
        for outcome in executor.run(todo, may_start, self._progress(), self._emit):
            outcomes.append(outcome)
            self._emit_outcome(outcome)
        return outcomes

    def _emit_outcome(self, outcome: Outcome) -> None:
        seconds = round(outcome.seconds, 3)
        about: dict[str, Any] = {
            "stage": self.name,
            "unit": outcome.name,
            "seconds": seconds,
        }
        if outcome.error:
            self.events.emit(
                "unit-failed", **about, error=outcome.error, trace=outcome.trace
            )
        else:
            self.events.emit("unit-done", **about, report=outcome.report)

    def _emit(self, event: str, **figures: Any) -> None:
        self.events.emit(event, stage=self.name, **figures)

    def _finish(
        self, inputs: FinishedInputs, tasks: Sequence[Task]
    ) -> tuple[Report, dict[str, str]]:
        """Write the stage's folder from its units; return the report or the error."""
        begun = time.monotonic()
        self.events.emit("finish-started", stage=self.name)
        try:
            return self._write_stage(inputs, tasks), {}
        except Exception as error:  # Recorded like a failed unit; other stages go on.
            trace, seconds = traceback.format_exc(), time.monotonic() - begun
            outcome = failure(FINISH, error, trace, seconds)
            self._emit_outcome(outcome)
            return {}, {FINISH: outcome.error}

    def _write_stage(self, inputs: FinishedInputs, tasks: Sequence[Task]) -> Report:
        started, begun = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
        about = stage_manifest(self.planned, tasks)
        finished: list[FinishedUnit] = finished_units(self.root, self.name, about)
        settings = self.planned.settings
        with publish(self.folder) as partial:
            report = self.planned.stage.finish(
                inputs, finished, partial, settings, self._progress()
            )
            same, varying = split_report(report)
            seconds = time.monotonic() - begun
            write_manifest(
                partial, {**about, "report": same}, Run(started, seconds, varying)
            )
        return same

    def _progress(self) -> Progress:
        def tell(done: float | int, total: float | int, note: str = "") -> None:
            self.events.emit("progress", stage=self.name, done=done, total=total, note=note)
            signals.raise_if_stopped()

        return tell

    def _write_attempt(self, tasks: Sequence[Task], failed: dict[str, str]) -> None:
        """Record the units of this attempt for ``status`` and ``gc``."""
        units = {task.unit.name: task.about["key"] for task in tasks}
        about = {"key": self.planned.key, "units": units, "failed": failed}
        write_json(self.root.attempt(self.name), about)

    def _remove_outputs(self, tasks: Sequence[Task]) -> None:
        """Remove what is to be made again: the stage, then its units."""
        for folder in (self.folder, *[task.target for task in tasks]):
            remove_folder(folder)

    def _remove_leftovers(self) -> None:
        """Remove what killed runs left, except what this stage can resume from."""
        stage = self.root.stage(self.name)
        for path in [*stage.glob("*"), *stage.glob("units/*")]:
            if path.name.endswith(PARTIAL):
                resumable = len(path.name) == KEY_DIGITS + len(PARTIAL)
                if self.forced or not (self.planned.stage.resumes and resumable):
                    _remove(path)
            elif _is_half_removed(path):
                _remove(path)


def _is_half_removed(path: Path) -> bool:
    """Whether this is a stage's or unit's folder without a manifest."""
    has_key = len(path.name) == KEY_DIGITS and path.is_dir()
    return has_key and not (path / MANIFEST).is_file()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        remove_folder(path)  # A worker of an earlier run may still write there.
    else:
        path.unlink(missing_ok=True)
