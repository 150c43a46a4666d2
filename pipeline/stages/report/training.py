"""How training runs went, side by side: from their logs to charts.

On its own: ``python -m pipeline.stages.report.training RUN... --out curves.svg`` compares
runs. A run is a log, a folder that holds one (a stage's, or a unit's that is still
training), or the root of an experiment, with a name before it if
wanted: ``SMART=work/smart``. The suffix of ``--out`` says what is written: one drawing
(``.svg`` or ``.pdf``) or a page (``.html``).
"""

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from infgen.errors import ConfigError
from infgen.views.charts.calibration import Bins
from infgen.views.charts.canvas import Chart, write_pdf, write_sheet
from infgen.views.charts.lines import Series
from infgen.views.charts.training import Run, training_charts
from infgen.views.page import render
from pipeline.engine.atomic import write_file
from pipeline.stages.train.train_log import read_log

LOG = "train.jsonl"
_PLACES = ("", LOG, f"latest/train/{LOG}")
_CONTROLS = ("keep", "add")

Line = Mapping[str, Any]


def read_run(path: Path, name: str) -> Run:
    """Read the log of a run; figures it does not hold are left out."""
    lines = read_log(path)
    train = [line for line in lines if "learning_rate" in line]
    validation_split = [
        {"step": line["step"], **line["validation"]}
        for line in lines
        if line.get("validation")
    ]
    curves = _curves(train)
    return Run(
        name=name,
        train=curves,
        weight={
            figure: curves[f"{_term(figure)}_count"].y
            for figure in curves
            if f"{_term(figure)}_count" in curves
        },
        validation=_curves(validation_split),
        bins=_bins(validation_split[-1]) if validation_split else {},
    )


def training_figures(path: Path, name: str) -> list[Chart]:
    """Draw how one run went; nothing without a log."""
    return training_charts([read_run(path, name)]) if path.is_file() else []


def _curves(lines: Sequence[Line]) -> dict[str, Series]:
    """Every number of some lines over their steps, unknown where a line lacks it."""
    step = np.array([line["step"] for line in lines], np.float64)
    names = dict.fromkeys(
        name for line in lines for name, value in line.items() if _is_number(value)
    )
    return {
        name: Series(
            name, step, np.array([_number(line.get(name)) for line in lines], np.float64)
        )
        for name in names
        if name != "step"
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(value: Any) -> float:
    return float(value) if _is_number(value) else float("nan")


def _term(figure: str) -> str:
    """Term of the loss that a figure belongs to: ``motion`` of ``motion_accuracy``."""
    return figure.split("_")[0]


def _bins(line: Line) -> dict[str, Bins]:
    """Reliability of one validation; where only overall rates are known, they are a bin."""
    found = {}
    for term in _CONTROLS:
        told = line.get(f"{term}_bins")
        if told:
            columns = [np.array(told[name], np.float64) for name in Bins.__annotations__]
            found[term] = Bins(*columns)
        elif f"{term}_predicted" in line:
            count = float(line[f"{term}_count"])
            rates = [line[f"{term}_{name}"] for name in ("predicted", "logged")]
            found[term] = Bins(*(np.array([count * part]) for part in (1.0, *rates)))
    return found


def find_log(word: str) -> tuple[str, Path]:
    """Find the log that a word of the command line means, and the run's name.

    Raises:
        ConfigError: if there is none.
    """
    name, sign, place = word.partition("=")
    if not sign or Path(word).exists():
        name, place = "", word
    for inner in _PLACES:
        path = Path(place) / inner if inner else Path(place)
        if path.is_file():
            return name or _called(path), path
    raise ConfigError(f"{place}: no {LOG} here, nor in {_PLACES[-1]}; expected a run")


def _called(path: Path) -> str:
    """Name a run by the folder of its log, or of its experiment."""
    parts = path.absolute().parent.parts
    return parts[-3] if parts[-2:] == ("latest", "train") else parts[-1]


def compare(words: Sequence[str], target: Path, title: str) -> None:
    """Draw several runs in the same charts and write them as one file.

    Raises:
        ConfigError: if a run has no log, or the suffix is unknown.
    """
    runs = [read_run(path, name) for name, path in map(find_log, words)]
    drawn = training_charts(runs)
    if target.suffix == ".svg":
        written = write_sheet(title, drawn).encode()
    elif target.suffix == ".pdf":
        written = write_pdf(drawn)
    elif target.suffix == ".html":
        written = render("training.html", title=title, charts=drawn).encode()
    else:
        raise ConfigError(f"--out {target}: expected a name ending in .svg, .pdf or .html")
    write_file(target, written)


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare the runs that the command line names."""
    parser = ArgumentParser(
        prog="python -m pipeline.stages.report.training",
        description=__doc__,
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("runs", metavar="RUN", nargs="+", help="[NAME=]log, folder or root")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--title", default="Training", help="above all")
    asked = parser.parse_args(arguments)
    try:
        compare(asked.runs, asked.out, asked.title)
    except (ConfigError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    sys.stdout.write(f"{asked.out}\n")


if __name__ == "__main__":
    main()
