"""What verbs have in common: run or look, show what became of it, leave with a code."""

import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from typing import Any

import typer

from pipeline import stopping, tables
from pipeline.events import Events
from pipeline.options import Asked, Running
from pipeline.request import Request
from pipeline.runner import Result
from pipeline.runner import run as make
from pipeline.screen import LiveTable, Screen
from pipeline.status import Standing, standings
from pipeline.watch import Look, Watcher

FAILED, WRONG, STALE, LOCKED = 1, 2, 3, 75
"""Exit codes, as ``cli.py`` tells them."""
IDLE_LOOKS = 2


def run_stages(
    request: Request, targets: Sequence[str], running: Running, *, as_json: bool
) -> None:
    """Run, show what became of it, and leave with the exit code that says so."""
    if running.dry_run:
        show_plan(request, targets, running, as_json=as_json)
        return
    plan = request.plan(targets, os.environ)
    orders = running.orders(targets, plan)
    request.remember(plan)
    with stopping.listening(), Screen() as screen:
        events = Events(request.root, (screen,))
        results = make(plan, orders, events)
    if as_json:
        log = str(events.log)
        print_json({"stages": [asdict(each) for each in results], "log": log})
    else:
        tables.show_results(request.root, results, events.log)
    if any(result.errors for result in results):
        raise typer.Exit(FAILED)
    _check_quarantine(request, results, running.max_bad)


def show_plan(
    request: Request, targets: Sequence[str], running: Running, *, as_json: bool
) -> None:
    """Say what a run would make, and why."""
    found = find_standings(request, targets, strict_code=running.strict_code)
    tell_standings(found, as_json=as_json)


def tell_standings(found: Sequence[Standing], *, as_json: bool) -> None:
    """Print how stages stand."""
    if as_json:
        print_json({"stages": [asdict(standing) for standing in found]})
    else:
        tables.show_standings(found)


def find_standings(
    request: Request, targets: Sequence[str], *, strict_code: bool
) -> list[Standing]:
    """Find how the stages stand that the targets need; all of them without targets."""
    plan = request.plan(targets, os.environ)
    return standings(plan, request.made(), strict_code=strict_code)


def watch_stages(asked: Asked, every_s: float, *, as_json: bool, check: bool) -> None:
    """Show how stages stand, again and again: until a signal comes, or nothing runs.

    Args:
        asked: What is watched.
        every_s: Seconds between two looks.
        as_json: One line of JSON per look.
        check: End when nothing runs (any more), with the code that says if any is stale.
    """
    watcher = Watcher(asked.request, os.environ)
    show, shown = _lookers(as_json=as_json)
    with stopping.listening(), shown:
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
) -> tuple[Callable[[Look], None], AbstractContextManager[object]]:
    """Who shows a look, and what is to be left when there is no more to show."""
    if as_json:
        return lambda look: typer.echo(json.dumps(asdict(look))), nullcontext()
    table = LiveTable()
    return partial(tables.show_look, table), table


def _check_quarantine(request: Request, results: Sequence[Result], max_bad: float) -> None:
    for result in results:
        bad, good = result.report.get("quarantined", 0), result.report.get("scenes", 0)
        if result.stage != "ingest" or not bad:
            continue
        share = bad / (bad + good)
        where = request.root.folder("ingest", result.key) / "quarantine.parquet"
        typer.echo(
            f"{bad} of {bad + good} records ({share:.2%}) are quarantined: {where}",
            err=True,
        )
        if share > max_bad:
            typer.echo(f"that is more than --max-bad {max_bad:g}", err=True)
            raise typer.Exit(STALE)


def print_json(value: Any) -> None:
    """Print a value; what JSON does not know is written as its text."""
    typer.echo(json.dumps(value, indent=1, default=str))
