"""A comparison on disk: tables in three forms, every number as JSON, and one page.

It is made once for what it shows, below ``store/comparison``, and ``presets/NAME`` leads to
the last one: a reader sees the whole of that, or of the one before.
"""

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from infgen.views.charts.canvas import write_pdf
from infgen.views.page import render
from pipeline.comparison.execution import ExecutedRun
from pipeline.comparison.figures import charts, curve_sheet
from pipeline.comparison.learning_curve import learning_curve_scores
from pipeline.comparison.result import ComparisonResult, compare
from pipeline.comparison.runs import PAGE, PRESET, SHOWN, Comparison
from pipeline.comparison.tables import caveats, standing_alone, tables
from pipeline.engine.atomic import MANIFEST, publish, remove_folder, write_file, write_json
from pipeline.engine.code_hash import code_hash
from pipeline.engine.layout import link
from pipeline.engine.manifest import Run, package_versions, write_manifest
from pipeline.engine.plan import digest
from pipeline.settings.presets import Arm, Preset

SCHEMA = "infgen.comparison/2"
STAGE, PRESETS = "comparison", "presets"
NUMBERS, TABLES, FIGURES = "comparison.json", "tables", "figures.pdf"
_MODULES = (
    "infgen.views.charts.canvas",
    "infgen.views.charts.lines",
    "infgen.views.page",
    "infgen.views.published",
    "infgen.views.sheets",
    "infgen.views.tables",
    "pipeline.comparison.claims",
    "pipeline.comparison.result",
    "pipeline.comparison.figures",
    "pipeline.comparison.learning_curve",
    "pipeline.comparison.proper",
    "pipeline.comparison.rules",
    "pipeline.comparison.statistics",
    "pipeline.comparison.scores",
    "pipeline.comparison.tables",
    "pipeline.comparison.write",
)
"""Whose code decides what is written: with other code it is written anew, in seconds."""


def write_comparison(
    comparison: Comparison, ran: Sequence[ExecutedRun], *, again: bool
) -> Path:
    """Write what the runs of a preset have scored; return the folder to look into.

    Args:
        comparison: The request.
        ran: All its runs; those that are not whole are named.
        again: Write it even if it is there.

    Raises:
        StoreError: if what the runs left is damaged.
    """
    root, preset = comparison.root, comparison.preset
    about = _about(preset, ran)
    folder = root.folder(STAGE, about["key"])
    if again:
        remove_folder(folder)
    if not (folder / MANIFEST).is_file():
        started, begun = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
        with publish(folder) as partial:
            _write(partial, compare(preset, ran))
            write_manifest(partial, about, Run(started, time.monotonic() - begun, {}))
    root.point(STAGE, about["key"])
    shown = root.path / PRESETS / preset.name
    link(shown, folder)
    comparison.remember({STAGE: about["key"]})
    return shown


def _about(preset: Preset, ran: Sequence[ExecutedRun]) -> dict[str, Any]:
    """What the manifest says; the key follows from it."""
    arms = [
        [*(arm.name, arm.label, arm.published, arm.ablates, arm.rules_of), _point(arm)]
        for arm in preset.arms.values()
    ]
    decides = {
        "schema": SCHEMA,
        "stage": STAGE,
        "version": 1,
        "code": code_hash(_MODULES),
        "settings": {PRESET: _shown_of(preset)},
        "arms": arms,
        "runs": [each.to_json() for each in ran],
    }
    empty: dict[str, Any] = {"inputs": {}, "sources": {}, "units": [], "report": {}}
    return {
        **decides,
        **empty,
        "key": digest(decides),
        "packages": package_versions(),
    }


def _shown_of(preset: Preset) -> dict[str, Any]:
    """Which words of a preset are shown."""
    return {
        "name": preset.name,
        "count_error": preset.count_error,
        "curve_axis": preset.curve_axis,
    }


def _point(arm: Arm) -> list[Any] | None:
    return None if arm.curve is None else [arm.curve.line, arm.curve.at]


def _write(folder: Path, found: ComparisonResult) -> None:
    sheets = tables(found)
    (folder / TABLES).mkdir()
    for sheet in [standing_alone(found, sheet) for sheet in sheets]:
        table = sheet.for_people()
        for suffix, text in (
            ("md", table.to_markdown()),
            ("tex", table.to_latex()),
            ("csv", sheet.for_programs().to_csv()),
        ):
            write_file(folder / TABLES / f"{sheet.name}.{suffix}", text.encode())
    # Thousands of rows: too many to be read as they are.
    points = learning_curve_scores(found)
    for curves in [curve_sheet(found), *([points] if points.rows else [])]:
        data = curves.for_programs().to_csv().encode()
        write_file(folder / TABLES / f"{curves.name}.csv", data)
    write_json(folder / NUMBERS, found.to_json())
    shown = {sheet.name: sheet.for_people() for sheet in sheets}
    told = {name: {"title": one.title, **one.to_json()} for name, one in shown.items()}
    write_json(folder / SHOWN, told)
    drawn = charts(found)
    write_file(folder / FIGURES, write_pdf(drawn))
    page = render(
        "comparison.html",
        title=f"{found.preset.name}: methods side by side",
        about=_words(found),
        caveats=caveats(found),
        missing=found.missing,
        tables=list(shown.values()),
        charts=drawn,
    )
    write_file(folder / PAGE, page.encode())


def _words(found: ComparisonResult) -> str:
    """What the page is about, in a sentence."""
    arms = ", ".join(arm.label for arm in found.arms) or "Nothing yet"
    scenes = " or ".join(map(str, sorted({one.scenes for one in found.scored}))) or "no"
    seeds = ", ".join(map(str, found.seeds)) or "none"
    return (
        f"{arms}: trained alike on the same records and simulated on {scenes} held-out "
        f"scenes; seeds: {seeds}."
    )
