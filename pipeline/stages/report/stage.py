"""Stage ``report``: everything before it to tables, figures and one page.

All is done in ``finish``; there are no units. What is written depends on the inputs alone,
but for the page of machines and times below ``run``.
"""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ReportSettings, RolloutSettings
from pipeline.engine.layout import RUN_FOLDER
from pipeline.engine.manifest import read_manifest
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.metrics.long_term.reference import Counts
    from infgen.views.tables import Table

STAGES = (
    "ingest",
    "build-vocab",
    "tokenize",
    "train",
    "calibrate",
    "rollout",
    "reference",
    "score",
)
LOWEST = 10
TABLES = "tables"
PASSPORT = "passport.html"


def plan(inputs: Inputs, settings: ReportSettings) -> list[Unit]:
    """No units: the report is one piece."""
    return []


def work(unit: Unit, target: Path, settings: ReportSettings, progress: Progress) -> Report:
    """Never called; there are no units.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"stage report has no unit {unit.name!r}")


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: ReportSettings,
    progress: Progress,
) -> Report:
    """Write every table in three forms, the table of scores as JSON too, and the page."""
    from infgen.views.page import page  # noqa: PLC0415
    from pipeline.engine.atomic import write_file, write_json  # noqa: PLC0415
    from pipeline.stages.report import histograms  # noqa: PLC0415
    from pipeline.stages.report.figures import find_lowest  # noqa: PLC0415
    from pipeline.stages.report.passport import passport  # noqa: PLC0415
    from pipeline.stages.report.players import write_players  # noqa: PLC0415
    from pipeline.stages.report.tables import worst_table  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    summary = json.loads((inputs.folder("score") / "summary.json").read_text())
    manifests = {stage: read_manifest(inputs.folder(stage)) for stage in STAGES}
    lowest = find_lowest(inputs.folder("score") / "scores.parquet", LOWEST)
    pages = write_players(inputs, target, lowest, settings.player_pages)
    scores, *more = [
        *_score_tables(summary, manifests),
        worst_table(lowest, pages),
    ]
    about = passport(inputs, manifests)
    counts = histograms.read_both(inputs)
    progress(1, 3, "tables")
    parts = _page(inputs, summary, manifests, [scores, *more], about, counts)
    progress(2, 3, "figures")
    _write_tables(target / TABLES, [scores, *more, *about, histograms.table(*counts)])
    _write_passport(inputs, target / RUN_FOLDER, settings.title)
    write_json(target / "table.json", scores.to_json())
    texts = {
        "table.csv": scores.to_csv(),
        "table.tex": "".join(table.to_latex() for table in (scores, *more)),
        "report.md": _markdown(settings.title, [scores, *more, *about]),
        "report.html": page(settings.title, parts),
    }
    for name, text in texts.items():
        write_file(target / name, text.encode())
    return {
        "scenes": summary["scenes"],
        "rollouts": summary["rollouts"],
        **{f"composite_{name}": _composite(summary, name) for name in summary["protocols"]},
        "mean_ace": summary["numbers"].get("ace/own_near", {}).get("mean"),
    }


def _write_tables(folder: Path, tables: "Sequence[Table]") -> None:
    """Write each table as Markdown, LaTeX and CSV, named after its title."""
    from pipeline.engine.atomic import write_file  # noqa: PLC0415

    folder.mkdir(exist_ok=True)
    for table in tables:
        name = re.sub(r"[^a-z0-9]+", "-", table.title.lower()).strip("-")
        for suffix, text in (
            ("md", table.to_markdown()),
            ("tex", table.to_latex()),
            ("csv", table.to_csv()),
        ):
            write_file(folder / f"{name}.{suffix}", text.encode())


def _write_passport(inputs: Inputs, folder: Path, title: str) -> None:
    """Write the page of machines and times."""
    from infgen.views.page import page  # noqa: PLC0415
    from pipeline.engine.atomic import write_file  # noqa: PLC0415
    from pipeline.stages.report.passport import times  # noqa: PLC0415

    folder.mkdir(exist_ok=True)
    parts = [table.to_html() for table in times(inputs, STAGES)]
    write_file(folder / PASSPORT, page(f"{title}: machines and times", parts).encode())


def _composite(summary: Mapping[str, Any], protocol: str) -> float | None:
    value: float | None = summary["protocols"][protocol]["scores"]["composite"]["mean"]
    return value


def _score_tables(
    summary: Mapping[str, Any], manifests: Mapping[str, Any]
) -> "list[Table]":
    from pipeline.stages.report import tables  # noqa: PLC0415

    rollout = RolloutSettings(**_section(manifests["rollout"], "rollout"))
    motion_only = not (rollout.inserts or rollout.removes)
    return [
        tables.score_table(summary),
        tables.long_term_table(summary, motion_only=motion_only),
        tables.short_term_table(summary),
        tables.divergence_table(summary),
    ]


def _page(
    inputs: Inputs,
    summary: Mapping[str, Any],
    manifests: Mapping[str, Any],
    tables: "Sequence[Table]",
    about: "Sequence[Table]",
    counts: "tuple[Counts, Counts]",
) -> list[str]:
    from infgen.views.page import figures, heading, inset, paragraph  # noqa: PLC0415
    from pipeline.stages.report import figures as drawings  # noqa: PLC0415
    from pipeline.stages.report import histograms  # noqa: PLC0415
    from pipeline.stages.report.training import LOG, training_figures  # noqa: PLC0415

    curves = drawings.read_curves(inputs.folder("score") / "curves.parquet", summary)
    training = training_figures(inputs.folder("train") / LOG, "this run")
    played = drawings.first_simulated(inputs)
    weights = manifests["train"]["report"].get("weights", "unknown")
    scores, long_term, short_term, *more = (table.to_html() for table in tables)
    return [
        paragraph(
            f"{summary['rollouts']} rollouts of {summary['scenes']} scenes, scored against "
            f"{summary['logs']} logs. Weights {weights}."
        ),
        heading("Scores"),
        scores,
        heading("Along the rollouts"),
        figures(drawings.score_charts(summary, curves)),
        heading("Beside the paper"),
        long_term,
        short_term,
        heading("A rollout"),
        figures(drawings.strips(played) if played else []),
        heading("Features and scenes"),
        figures(histograms.charts(*counts)),
        *more,
        heading("Training"),
        figures(training),
        heading("Run passport"),
        *(table.to_html() for table in about),
        heading("Machines and times"),
        inset(
            f"{RUN_FOLDER}/{PASSPORT}",
            "Machines and times differ from run to run, so they stand beside this page:",
        ),
    ]


def _markdown(title: str, tables: "Sequence[Table]") -> str:
    from infgen.views.tables import markdown  # noqa: PLC0415

    return "\n".join([f"# {markdown(title)}\n", *(table.to_markdown() for table in tables)])


def _section(manifest: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Settings of one section, whether a stage has one section or several."""
    settings: Mapping[str, Any] = manifest["settings"]
    found: Mapping[str, Any] = settings.get(name, settings)
    return found


STAGE = Stage(
    name="report",
    version=4,
    settings={"report": ReportSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "pipeline.stages.report.stage",
        "pipeline.stages.report.figures",
        "pipeline.stages.report.histograms",
        "pipeline.stages.report.passport",
        "pipeline.stages.report.players",
        "pipeline.stages.report.tables",
        "pipeline.stages.report.training",
        "pipeline.stages.train.train_log",
    ),
)
