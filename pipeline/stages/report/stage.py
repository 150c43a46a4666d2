"""Stage ``report``: everything before it to tables, figures and one page.

All is done in ``finish``; there are no units. What is written depends on the inputs alone,
but for the page of machines and times below ``run``.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ReportSettings, RolloutSettings
from pipeline.engine.layout import RUN_FOLDER
from pipeline.engine.manifest import read_manifest
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.metrics.long_term.reference import Counts
    from infgen.views.charts.canvas import Chart
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
TABLES, FIGURES = "tables", "figures.pdf"
PASSPORT = "passport.html"
PROPER_CURVES = "proper_curves.parquet"


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
    """Write the page, every table in three forms, and every chart as PDF."""
    from infgen.views.charts.canvas import write_pdf  # noqa: PLC0415
    from infgen.views.page import render  # noqa: PLC0415
    from pipeline.engine.atomic import write_file, write_json  # noqa: PLC0415
    from pipeline.stages.report import histograms  # noqa: PLC0415
    from pipeline.stages.report.figures import find_lowest  # noqa: PLC0415
    from pipeline.stages.report.passport import passport  # noqa: PLC0415
    from pipeline.stages.report.players import write_players  # noqa: PLC0415
    from pipeline.stages.report.proper import proper_tables  # noqa: PLC0415
    from pipeline.stages.report.tables import worst_table  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    summary = json.loads((inputs.folder("score") / "summary.json").read_text())
    manifests = {stage: read_manifest(inputs.folder(stage)) for stage in STAGES}
    lowest = find_lowest(inputs.folder("score") / "scores.parquet", LOWEST)
    pages = write_players(inputs, target, lowest, settings.player_pages)
    tables = [*score_tables(summary, manifests), worst_table(lowest, pages)]
    about, proper = passport(inputs, manifests), proper_tables(summary)
    counts = histograms.read_both(inputs)
    progress(1, 3, "tables")
    charts = _charts(inputs, summary, counts)
    values = {
        "title": settings.title,
        "summary": summary,
        "weights": manifests["train"]["report"].get("weights", "unknown"),
        "scores": tables[0],
        "paper_tables": tables[1:3],
        "proper_tables": proper,
        "feature_tables": tables[3:],
        "passport_tables": about,
        "machines_page": f"{RUN_FOLDER}/{PASSPORT}",
        "strips": _strips(inputs),
        **charts,
    }
    page = render("report.html", **values)
    progress(2, 3, "figures")
    every = [*tables, *proper, *about]
    _write_tables(target / TABLES, [*every, histograms.table(*counts)])
    figures = write_pdf(chart for part in charts.values() for chart in part)
    write_file(target / FIGURES, figures)
    _write_passport(inputs, target / RUN_FOLDER, settings.title)
    write_json(target / "table.json", tables[0].to_json())
    texts = {
        "table.csv": tables[0].to_csv(),
        "table.tex": "".join(table.to_latex() for table in [*tables, *proper]),
        "report.md": _markdown(settings.title, every),
        "report.html": page,
    }
    for name, text in texts.items():
        write_file(target / name, text.encode())
    return {
        "scenes": summary["scenes"],
        "rollouts": summary["rollouts"],
        **{f"composite_{name}": _composite(summary, name) for name in summary["protocols"]},
        "mean_ace": summary["numbers"].get("ace/own_near", {}).get("mean"),
    }


def _charts(
    inputs: Inputs, summary: Mapping[str, Any], counts: "tuple[Counts, Counts]"
) -> "dict[str, Sequence[Chart]]":
    """Charts by the name that the page has for them."""
    from pipeline.stages.report import figures, histograms  # noqa: PLC0415
    from pipeline.stages.report.proper import proper_charts  # noqa: PLC0415
    from pipeline.stages.report.training import LOG, training_figures  # noqa: PLC0415

    curves = figures.read_curves(inputs.folder("score") / "curves.parquet", summary)
    return {
        "score_charts": figures.score_charts(summary, curves),
        "proper_charts": proper_charts(summary, inputs.folder("score") / PROPER_CURVES),
        "histogram_charts": histograms.charts(*counts),
        "training_charts": training_figures(inputs.folder("train") / LOG, "this run"),
    }


def _strips(inputs: Inputs) -> list[str]:
    """Draw the first scene and a rollout of it, as SVG; nothing without rollouts."""
    from pipeline.stages.report.figures import first_simulated, strips  # noqa: PLC0415

    found = first_simulated(inputs)
    return strips(found) if found else []


def _write_tables(folder: Path, tables: "Sequence[Table]") -> None:
    """Write each table as Markdown, LaTeX and CSV, named after its title."""
    from pipeline.engine.atomic import write_file  # noqa: PLC0415

    folder.mkdir(exist_ok=True)
    for table in tables:
        for suffix, text in (
            ("md", table.to_markdown()),
            ("tex", table.to_latex()),
            ("csv", table.to_csv()),
        ):
            write_file(folder / f"{table.name}.{suffix}", text.encode())


def _write_passport(inputs: Inputs, folder: Path, title: str) -> None:
    """Write the page of machines and times."""
    from infgen.views.page import render  # noqa: PLC0415
    from pipeline.engine.atomic import write_file  # noqa: PLC0415
    from pipeline.stages.report.passport import times  # noqa: PLC0415

    folder.mkdir(exist_ok=True)
    values = {"title": f"{title}: machines and times", "tables": times(inputs, STAGES)}
    write_file(folder / PASSPORT, render("tables.html", **values).encode())


def _composite(summary: Mapping[str, Any], protocol: str) -> float | None:
    value: float | None = summary["protocols"][protocol]["scores"]["composite"]["mean"]
    return value


def score_tables(summary: Mapping[str, Any], manifests: Mapping[str, Any]) -> "list[Table]":
    """Tables of scores: the run's own, two beside the paper's, and divergences."""
    from pipeline.stages.report import tables  # noqa: PLC0415

    rollout = RolloutSettings(**_section(manifests["rollout"], "rollout"))
    motion_only = not (rollout.inserts or rollout.removes)
    return [
        tables.score_table(summary),
        tables.long_term_table(summary, motion_only=motion_only),
        tables.short_term_table(summary),
        tables.divergence_table(summary),
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
    version=6,
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
        "pipeline.stages.report.proper",
        "pipeline.stages.report.tables",
        "pipeline.stages.report.training",
        "pipeline.stages.train.train_log",
    ),
)
