"""Stage ``report``: everything before it to tables, figures and one page.

All is done in ``finish``; there are no units. What is written depends on the inputs alone:
times and machines are in the engine's ``run.json``.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ReportSettings, RolloutSettings
from pipeline.manifest import read_manifest
from pipeline.stage import Done, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.views.tables import Table

STAGES = ("ingest", "build-vocab", "tokenize", "train", "rollout", "score")
LOWEST = 10
MAX_QUARANTINED = 20
_KEY_DIGITS = 16


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
    units: Sequence[Done],
    target: Path,
    settings: ReportSettings,
    progress: Progress,
) -> Report:
    """Write the table of scores in five forms, and the page."""
    from infgen.views.page import page  # noqa: PLC0415
    from pipeline.folders import write_file, write_json  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    summary = json.loads((inputs.folder("score") / "summary.json").read_text())
    manifests = {stage: read_manifest(inputs.folder(stage)) for stage in STAGES}
    scores, *more = _score_tables(inputs, summary, manifests)
    about = _passport(inputs, manifests)
    progress(1, 3, "tables")
    parts = _page(inputs, summary, manifests, [scores, *more], about)
    progress(2, 3, "figures")
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


def _composite(summary: Mapping[str, Any], protocol: str) -> float | None:
    value: float | None = summary["protocols"][protocol]["scores"]["composite"]["mean"]
    return value


def _score_tables(
    inputs: Inputs, summary: Mapping[str, Any], manifests: Mapping[str, Any]
) -> "list[Table]":
    from pipeline import report_tables as tables  # noqa: PLC0415
    from pipeline.report_figures import lowest  # noqa: PLC0415

    rollout = RolloutSettings(**_section(manifests["rollout"], "rollout"))
    motion_only = not (rollout.inserts or rollout.removes)
    return [
        tables.score_table(summary),
        tables.long_term_table(summary, motion_only=motion_only),
        tables.short_term_table(summary),
        tables.divergence_table(summary),
        tables.worst_table(lowest(inputs.folder("score") / "scores.parquet", LOWEST)),
    ]


def _passport(inputs: Inputs, manifests: Mapping[str, Any]) -> "list[Table]":
    """What was run on what: keys, settings, versions, counts and what was left out."""
    from infgen.views.tables import Table, flatten  # noqa: PLC0415

    stages = [
        [
            name,
            found["key"][:_KEY_DIGITS],
            found["version"],
            found["code"][:_KEY_DIGITS],
            len(found["units"]),
        ]
        for name, found in manifests.items()
    ]
    settings = [
        [f"{name}: {setting}", value]
        for name, found in manifests.items()
        for setting, value in flatten(found["settings"])
    ]
    figures = [
        [f"{name}: {figure}", value]
        for name, found in manifests.items()
        for figure, value in flatten(found["report"])
    ]
    packages = flatten(manifests["score"]["packages"])
    sources = [
        [name, mark] for name, mark in sorted(manifests["ingest"]["sources"].items())
    ]
    return [
        Table("Stages", ["stage", "key", "version", "code", "units"], stages),
        Table("Counts", ["figure", "value"], figures),
        *_vocabulary(inputs),
        _quarantine(inputs),
        Table("Sources", ["file", "fingerprint"], sources),
        Table("Settings", ["setting", "value"], settings),
        Table("Versions", ["package", "version"], packages),
    ]


def _vocabulary(inputs: Inputs) -> "list[Table]":
    from infgen.views.tables import Table, flatten  # noqa: PLC0415

    path = inputs.folder("build-vocab") / "report.json"
    if not path.is_file():
        return []
    rows = flatten(json.loads(path.read_text()))
    return [Table("Vocabularies", ["figure", "value"], rows)]


def _quarantine(inputs: Inputs) -> "Table":
    import polars as pl  # noqa: PLC0415

    from infgen.views.tables import Table  # noqa: PLC0415

    found = pl.read_parquet(inputs.folder("ingest") / "quarantine.parquet")
    shown = min(MAX_QUARANTINED, len(found))
    return Table(
        "Quarantined records",
        found.columns,
        list(found.head(shown).iter_rows()),
        note=f"{shown} of {len(found)}; all are in quarantine.parquet of stage ingest.",
    )


def _page(
    inputs: Inputs,
    summary: Mapping[str, Any],
    manifests: Mapping[str, Any],
    tables: "Sequence[Table]",
    about: "Sequence[Table]",
) -> list[str]:
    from infgen.views.page import figures, heading, paragraph  # noqa: PLC0415
    from pipeline import report_figures as drawings  # noqa: PLC0415
    from pipeline.report_training import LOG, training_figures  # noqa: PLC0415

    curves = drawings.read_curves(inputs.folder("score") / "curves.parquet", summary)
    training = training_figures(inputs.folder("train") / LOG, "this run")
    played = drawings.first_played(inputs)
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
        *more,
        heading("Training"),
        figures(training),
        heading("Run passport"),
        *(table.to_html() for table in about),
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
    version=2,
    settings={"report": ReportSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "infgen.views.axes",
        "infgen.views.calibration",
        "infgen.views.figures",
        "infgen.views.page",
        "infgen.views.published",
        "infgen.views.scene_picture",
        "infgen.views.tables",
        "infgen.views.training",
        "pipeline.report",
        "pipeline.report_figures",
        "pipeline.report_tables",
        "pipeline.report_training",
        "pipeline.train_log",
    ),
)
