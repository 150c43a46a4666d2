"""What is printed of stages, their scores, exports, and the state of a root."""

import time
from collections.abc import Iterable, Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands.doctor import Check
from pipeline.commands.screen import LiveTable, console, gibibytes, show_table
from pipeline.commands.watch import RootSnapshot, Row
from pipeline.comparison.runs import PAGE, SHOWN
from pipeline.engine.garbage import Garbage
from pipeline.engine.layout import KEY_DIGITS, Root, read_json
from pipeline.engine.plan import StageEntry
from pipeline.engine.progress import amount, clock_time, rate
from pipeline.engine.runner import StageResult
from pipeline.engine.status import StageStatus

if TYPE_CHECKING:
    from pipeline.commands.export_job import Exported
    from pipeline.commands.wosac import Official
    from pipeline.comparison.dry_run import DryRun
    from pipeline.comparison.execution import ExecutedRun
    from pipeline.settings.described import Section
    from pipeline.storage.towns import Written

SCENES_PER_TABLE = 5
SCORES = "table.json"
"""In the report's folder: ``{"columns": [...], "rows": [[...]]}``."""
_AT_ONCE = ("claims", "against-the-logs")
"""Tables of a comparison that are printed, of each split; all are in its folder."""


def show_statuses(found: Sequence[StageStatus]) -> None:
    """Print how stages stand."""
    rows = [
        (each.stage, each.state, each.progress, each.key[:KEY_DIGITS], each.why)
        for each in found
    ]
    show_table("stages", ("stage", "state", "units", "key", "why"), rows)


_WATCHED = (
    *("stage", "state", "done", "rate", "left", "memory", "at work"),
    *("quarantined", "failed", "note"),
)


def show_snapshot(table: LiveTable, look: RootSnapshot) -> None:
    """Show how stages stand at one moment, in place or in lines."""
    runs = dict.fromkeys(row.run for row in look.rows if row.run)
    words = "\n".join([*runs, look.trouble]).strip()
    rows = [_watched(row) for row in look.rows]
    if not table.alive:
        for row, (name, state, *cells) in zip(look.rows, rows, strict=True):
            told = ", ".join([str(state), *_said(cells)])
            table.tell(str(name), f"{state} {row.failed}", told)
        table.tell("", words, words)
        return
    # Columns that would be empty are left out.
    used = [at for at in range(len(_WATCHED)) if any(row[at] is not None for row in rows)]
    title = time.strftime("stages at %H:%M:%S", time.localtime(look.time_s))
    columns = [_WATCHED[at] for at in used]
    table.draw(title, columns, [[row[at] for at in used] for row in rows], words)


def _watched(row: Row) -> tuple[str | int | None, ...]:
    return (
        row.stage,
        row.state,
        _done(row),
        rate(row.per_s) if row.per_s is not None else None,
        clock_time(row.remaining_s) if row.remaining_s is not None else None,
        gibibytes(row.memory_bytes) if row.memory_bytes is not None else None,
        row.at_work or None,
        row.quarantined,
        row.failed or None,
        row.note or None,
    )


def _done(row: Row) -> str | None:
    if row.done is None or row.units is None:
        return None
    what = "" if row.what == "units" else f" {row.what}"
    return f"{amount(row.done)} of {amount(row.units)}{what}"


def _said(cells: Sequence[str | int | None]) -> list[str]:
    """The cells after name and state, in words."""
    forms = ("{}", "{}", "{} left", "{}", "{} at work", "{} quarantined", "{} failed", "{}")
    return [
        form.format(cell)
        for form, cell in zip(forms, cells, strict=True)
        if cell is not None
    ]


def graph_text(stages: Iterable[StageEntry], *, mermaid: bool) -> str:
    """Write which stage reads which, as lines or as a Mermaid chart."""
    if mermaid:
        arrows = [f"  {dep} --> {each.name}" for each in stages for dep in each.deps]
        return "\n".join(["flowchart LR", *arrows])
    return "\n".join(f"{each.name:<12} <- {', '.join(each.deps)}" for each in stages)


def show_results(root: Root, results: Sequence[StageResult], log: Path) -> None:
    """Print what became of stages, what failed and why, and the scores if there are any."""
    rows = [
        (each.stage, each.state, each.units, each.made, each.seconds, each.words)
        for each in results
    ]
    columns = ("stage", "state", "units", "made now", "seconds", "figures")
    show_table("run", columns, rows)
    errors = [
        f"{result.stage}: {unit}: {error}"
        for result in results
        for unit, error in result.errors.items()
    ]
    for line in errors:
        _warn(line)
    if errors:
        console(stderr=True).print(f"tracebacks are in {log}", soft_wrap=True)
    _show_scores(root, results)


def show_dry_run(found: "Sequence[DryRun]") -> None:
    """Print what the runs of a preset would make."""
    rows = [(each.run, ", ".join(each.makes) or "nothing", each.note) for each in found]
    show_table(f"{len(found)} runs", ("run", "to make", "note"), rows)


def show_runs(ran: "Sequence[ExecutedRun]", shown: Path | None, log: Path) -> None:
    """Print what became of the runs of a preset, and what they add up to."""
    rows = [
        (
            each.arm_run.words,
            each.state,
            sum(result.made for result in each.results),
            each.seconds,
        )
        for each in ran
    ]
    show_table("runs", ("run", "state", "units made now", "seconds"), rows)
    missing = [f"{each.arm_run.words}: {each.why}" for each in ran if not each.is_whole]
    for line in missing:
        _warn(line)
    if missing:
        console(stderr=True).print(f"tracebacks are in {log}", soft_wrap=True)
    if shown is None:
        return
    told = read_json(shown / SHOWN)
    for name, table in told.items():
        if name.startswith(_AT_ONCE):
            show_table(table["title"], table["columns"], table["rows"])
    console().print(f"comparison: {shown / PAGE}", soft_wrap=True)


def _show_scores(root: Root, results: Sequence[StageResult]) -> None:
    whole = [each for each in results if each.state in ("made", "cached")]
    table = root.path / "report" / SCORES
    if any(each.stage == "report" for each in whole) and table.is_file():
        scores = read_json(table)
        show_table("scores", scores["columns"], scores["rows"])
        console().print(f"report: {root.path / 'report'}", soft_wrap=True)


def show_garbage(found: Sequence[Garbage], *, removed: bool) -> None:
    """Print what nothing needs any more, and whether it is gone."""
    rows = [(each.path, gibibytes(each.bytes), each.why) for each in found]
    total = gibibytes(sum(each.bytes for each in found))
    done = "removed" if removed else "to remove with --yes"
    show_table(f"{total} {done}", ("folder", "size", "what"), rows)


def show_checks(checks: Sequence[Check]) -> None:
    """Print what was looked at, and how it is."""
    rows = [(check.what, check.state, check.note) for check in checks]
    show_table("doctor", ("what", "state", "note"), rows)


def show_settings(found: "Sequence[Section]") -> None:
    """Print a table of settings for each section."""
    for section in found:
        rows = [(each.name, str(each.default), each.meaning) for each in section.settings]
        title = f"{section.name}: {section.about}"
        show_table(title, ("setting", "default", "what it is"), rows)


def show_towns(found: "Written") -> None:
    """Print what was written."""
    rows = [
        ("written", found.out),
        ("scenes", found.scenes),
        ("files", len(found.files)),
        ("size", gibibytes(found.bytes)),
    ]
    if found.before:
        rows.append(("files written before", found.before))
    show_table("towns", ("what", "value"), rows)


def show_exported(found: "Exported") -> None:
    """Print what was written, and what a reader should know of it."""
    rows = [
        ("written", found.out),
        ("scenes", found.scenes),
        ("rollouts", found.rollouts),
        ("files", found.files),
        ("size", gibibytes(found.bytes)),
    ]
    if found.before:
        rows.append(("scenes written before", found.before))
    if found.unused:
        rows.append(("rollouts left out", found.unused))
    if found.filled:
        agents = f"{sum(found.filled.values())} in {len(found.filled)} scenes"
        rows.append(("agents without a model, at constant velocity", agents))
    show_table(f"export to {found.format}", ("what", "value"), rows)
    for line in found.not_simulated:
        _warn(f"not simulated, so not in it: {line}")


def show_official(found: "Official", *, per_scene: bool) -> None:
    """Print the official scores' means, each scene if asked, and what was refused."""
    if found.scores:
        title = f"{found.metric}, mean over {len(found.scores)} scenes"
        rows = [(name, _official(value)) for name, value in found.mean().items()]
        show_table(title, ("score", "mean"), rows)
    scenes = list(found.scores.values()) if per_scene else []
    for first in range(0, len(scenes), SCENES_PER_TABLE):
        some = scenes[first : first + SCENES_PER_TABLE]
        numbers = [one.numbers() for one in some]
        columns = ("score", *(one.scenario_id for one in some))
        cells = [(name, *(_official(n[name]) for n in numbers)) for name in numbers[0]]
        title = f"scenes {first + 1} to {first + len(some)} of {len(scenes)}"
        show_table(title, columns, cells)
    for name, reason in found.refused:
        _warn(f"refused: {name}: {reason}")


def _official(value: float) -> str:
    from infgen.views.tables import NOT_MEASURED  # noqa: PLC0415

    return NOT_MEASURED if isnan(value) else f"{value:.5f}"


def _warn(line: str) -> None:
    console(stderr=True).print(line, markup=False, highlight=False, soft_wrap=True)
