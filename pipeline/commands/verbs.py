"""What verbs have in common: run or look, show what became of it, leave with a code."""

import json
import os
import sys
import time
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import typer

from infgen.errors import ConfigError
from pipeline.commands import tables
from pipeline.commands.options import ComparisonOptions, RequestOptions, RunFlags
from pipeline.commands.screen import LiveTable, Screen
from pipeline.commands.watch import RootSnapshot, Watcher
from pipeline.comparison.dry_run import DryRun, plan_dry_run
from pipeline.comparison.execution import ExecutedRun, execute_arm_runs
from pipeline.comparison.records import find_records
from pipeline.comparison.runs import REPORT, Comparison, arm_runs_of
from pipeline.engine import signals
from pipeline.engine.atomic import StoreError
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.locks import LockedError
from pipeline.engine.plan import Plan, PlanError
from pipeline.engine.runner import RunOptions, StageResult
from pipeline.engine.runner import run as make
from pipeline.engine.status import StageStatus, stage_statuses
from pipeline.settings.request import Request

FAILED, WRONG, STALE, LOCKED = 1, 2, 3, 75
"""Exit codes, as in the help of ``cli.py``."""
IDLE_LOOKS = 2
MOST_NAMED = 3
"""Most quarantined records that are printed."""


def run_stages(
    request: Request, targets: Sequence[str], running: RunFlags, *, as_json: bool
) -> None:
    """Run, show what became of it, and leave with the exit code that says so."""
    plan = request.plan(targets, os.environ)
    run_options = running.run_options(targets, plan)
    if running.dry_run:
        found = stage_statuses(plan, request.made(), strict_code=running.strict_code)
        again = plan.after(run_options.force)
        print_statuses([_asked_again(each, again) for each in found], as_json=as_json)
        return
    with request.remembered(plan), signals.handling_signals(), Screen() as screen:
        events = Events(request.root, (screen,))
        results = make(plan, run_options, events)
    if as_json:
        log = str(events.log)
        print_json({"stages": [asdict(each) for each in results], "log": log})
    else:
        tables.show_results(request.root, results, events.log)
    if any(result.errors for result in results):
        raise typer.Exit(FAILED)
    _check_quarantine(request.root, results, running.max_bad)


def compare_arms(
    request_options: RequestOptions,
    comparing: ComparisonOptions,
    targets: Sequence[str],
    running: RunFlags,
    *,
    as_json: bool,
) -> None:
    """Run every arm of a preset, set them side by side, and leave with an exit code."""
    comparison = comparing.comparison(request_options, targets)
    preset = comparison.preset
    arms = preset.chosen(comparing.arm_names)
    arm_runs = arm_runs_of(comparison, arms, comparing.seeds or preset.seeds)
    for arm_run in arm_runs:
        comparison.sketch(
            arm_run
        )  # What is wrong with the settings is told before all else.
    if running.dry_run:
        _print_dry_run(plan_dry_run(comparison, arm_runs), as_json=as_json)
        return
    with signals.handling_signals(), Screen() as screen:
        events = Events(comparison.root, (screen,))
        ready = find_records(comparison, screen)
        comparison.remember({})
        ran = execute_arm_runs(
            ready, arm_runs, _orders(running, comparison, targets), events
        )
        shown = None
        if REPORT in comparison.targets:
            from pipeline.comparison.write import write_comparison  # noqa: PLC0415

            shown = write_comparison(comparison, ran, again=running.force)
    _print_runs(ran, shown, events, as_json=as_json)
    if not all(each.is_whole for each in ran):
        raise typer.Exit(FAILED)
    results = {result.key: result for each in ran for result in each.results}
    _check_quarantine(comparison.root, list(results.values()), running.max_bad)


def _orders(
    running: RunFlags, comparison: Comparison, targets: Sequence[str]
) -> Callable[[Plan], RunOptions]:
    def order(plan: Plan) -> RunOptions:
        # What some runs do not come by is no mistake, if others do.
        elsewhere = running.begin in comparison.stages and running.begin not in plan.stages
        own = replace(running, begin=None) if elsewhere else running
        return own.run_options(targets, plan)

    return order


def _print_dry_run(found: Sequence[DryRun], *, as_json: bool) -> None:
    if as_json:
        print_json({"runs": [asdict(each) for each in found]})
    else:
        tables.show_dry_run(found)


def _print_runs(
    ran: Sequence[ExecutedRun], shown: Path | None, events: Events, *, as_json: bool
) -> None:
    if as_json:
        runs = [{**each.to_json(), "state": each.state} for each in ran]
        print_json({"runs": runs, "comparison": shown, "log": str(events.log)})
    else:
        tables.show_runs(ran, shown, events.log)


def _asked_again(standing: StageStatus, again: Container[str]) -> StageStatus:
    if standing.state != "cached" or standing.stage not in again:
        return standing
    return replace(standing, state="stale", why="made again, as it is asked to be", made=0)


def print_statuses(found: Sequence[StageStatus], *, as_json: bool) -> None:
    """Print how stages stand."""
    if as_json:
        print_json({"stages": [asdict(standing) for standing in found]})
    else:
        tables.show_statuses(found)


def find_statuses(request: Request, *, strict_code: bool) -> list[StageStatus]:
    """Find how all stages stand."""
    plan = request.plan([], os.environ)
    return stage_statuses(plan, request.made(), strict_code=strict_code)


def watch_stages(
    request_options: RequestOptions, every_s: float, *, as_json: bool, check: bool
) -> None:
    """Show how stages stand, again and again: until a signal comes, or nothing runs.

    Args:
        request_options: What is watched.
        every_s: Seconds between two looks.
        as_json: One line of JSON per look.
        check: End when nothing runs (any more), with the code that says if any is stale.
    """
    watcher = Watcher(request_options.request, os.environ)
    show, shown = _lookers(as_json=as_json)
    with signals.handling_signals(), shown:
        idle = 0  # Looks in a row. Between two stages, too, nothing runs for a moment.
        while True:
            look = watcher.look()
            show(look)
            idle = 0 if look.running else idle + 1
            if check and idle == IDLE_LOOKS:
                break
            time.sleep(every_s)
    if not look.rows or any(row.state != "cached" for row in look.rows):
        raise typer.Exit(STALE)


def _lookers(
    *, as_json: bool
) -> tuple[Callable[[RootSnapshot], None], AbstractContextManager[object]]:
    """Who shows a look, and what is to be left when there is no more to show."""
    if as_json:
        return lambda look: typer.echo(json.dumps(asdict(look))), nullcontext()
    table = LiveTable()
    return partial(tables.show_snapshot, table), table


def _check_quarantine(root: Root, results: Sequence[StageResult], max_bad: float) -> None:
    for result in results:
        bad, good = result.report.get("quarantined", 0), result.report.get("scenes", 0)
        if result.stage != "ingest" or not bad:
            continue
        share = bad / (bad + good)
        where = root.folder("ingest", result.key) / "quarantine.parquet"
        told = f"{bad} of {bad + good} records ({share:.2%}) are quarantined: {where}"
        typer.echo("\n".join([told, *_set_aside(where)]), err=True)
        if share > max_bad:
            typer.echo(f"that is more than --max-bad {max_bad:g}", err=True)
            raise typer.Exit(STALE)


def _set_aside(table: Path) -> Iterator[str]:
    """Name some records that were set aside, and why."""
    import polars as pl  # noqa: PLC0415

    found = pl.read_parquet(table, columns=["source", "record", "reason"])
    for source, record, reason in found.head(MOST_NAMED).iter_rows():
        yield f"  {source}, record {record}: {reason}"
    if found.height > MOST_NAMED:
        yield f"  and {found.height - MOST_NAMED} more in that table"


def print_json(value: Any, *, spread: bool | None = None) -> None:
    """Print a value; what JSON does not know is written as its text.

    Args:
        value: To print.
        spread: Over several lines; None for where somebody reads. In a file every run is
            one line, so that ``>>`` makes JSONL of them.
    """
    spread = sys.stdout.isatty() if spread is None else spread
    typer.echo(json.dumps(value, indent=1 if spread else None, default=str))


def exit_code(error: BaseException) -> int:
    """Exit code of a known error; an unknown one goes on as a traceback."""
    if isinstance(error, signals.Stopped):
        return 128 + error.signal
    if isinstance(error, LockedError):
        return LOCKED
    if isinstance(error, ConfigError | PlanError):
        return WRONG
    if isinstance(error, StoreError | OSError):
        return FAILED
    ours = type(error).__module__.split(".")[0] in ("infgen", "pipeline")
    if isinstance(error, ValueError) and ours:
        return FAILED
    raise error


def tell_error(error: BaseException, *, as_json: bool) -> int:
    """Print a known error as one line, with JSON as an object too; return its exit code."""
    code = exit_code(error)
    typer.echo(f"infgen: {error}", err=True)
    if as_json:  # For programs that collect the lines.
        print_json({"error": str(error), "exit_code": code})
    return code
