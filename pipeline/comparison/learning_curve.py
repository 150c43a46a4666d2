"""Learning curves: scores of arms that are points of a line, over what was learned."""

import math
from collections.abc import Iterator

import numpy as np

from infgen.views.charts.canvas import Chart
from infgen.views.charts.lines import Series, line_chart
from infgen.views.sheets import Measured, Sheet, SheetCell
from pipeline.comparison.proper import SCORES
from pipeline.comparison.result import LONG, OFFICIAL_PLAY, ComparisonResult
from pipeline.comparison.runs import TRAIN
from pipeline.settings.presets import Arm

NAME = "learning-curve"
PROPER = "proper/"
_OFFICIAL = {"wosac/metametric": "Waymo's metric, 8 s"}


def learning_curve(found: ComparisonResult) -> Sheet:
    """Give the scores of every point, line by line and from few to many."""
    rows: list[list[SheetCell]] = []
    for line, x, arm in points(found):
        numbers = _numbers(found, arm)
        rows.append([line, x, *[numbers.get(name) for name in _columns(found)]])
    return Sheet(
        name=NAME,
        title=f"Learning curve: scores over {found.preset.curve_axis}",
        columns=["line", found.preset.curve_axis, *_columns(found).values()],
        rows=rows,
        note="Energy scores and distances (W1): less is better. Skill and likelihood: more "
        "is better. Spread over error is best at 1.",
    )


def learning_curve_scores(found: ComparisonResult) -> Sheet:
    """Every score of protocol ``proper`` of every point, a row each."""
    rows: list[list[SheetCell]] = []
    for split, part in found.by_split.items():
        for line, x, arm in points(part):
            rows += [
                [line, split, x, name.removeprefix(PROPER), one]
                for name, one in _numbers(part, arm).items()
                if name.startswith(PROPER)
            ]
    columns = ["line", "split", found.preset.curve_axis, "score", "value"]
    return Sheet(f"{NAME}-scores", "Learning curve: every proper score", columns, rows)


def learning_curve_charts(found: ComparisonResult, where: str) -> Iterator[Chart]:
    """Draw every score of the table over a logarithmic axis.

    Args:
        found: What the runs have scored.
        where: End of the titles.
    """
    placed = points(found)
    for name, label in _columns(found).items():
        lines = []
        for line in dict.fromkeys(line for line, _, _ in placed):
            own = [(x, _mean(found, arm, name)) for at, x, arm in placed if at == line]
            x, y = np.array(own, np.float64).T
            if not np.isnan(y).all():
                lines.append(Series(line, x, y))
        if lines:
            yield line_chart(
                lines,
                title=f"Learning curve: {label}{where}",
                x_label=found.preset.curve_axis,
                y_label=label,
                log_x=True,
            )


def points(found: ComparisonResult) -> list[tuple[str, int, Arm]]:
    """List the arms that are points of a line: its name, their place, and the arm."""
    placed = [
        (arm.curve.line, x, arm)
        for arm in found.arms
        if arm.curve is not None
        and (x := arm.curve.at or scenes_shown(found, arm)) is not None
    ]
    lines = list(dict.fromkeys(line for line, _, _ in placed))
    return sorted(placed, key=lambda point: (lines.index(point[0]), point[1]))


def scenes_shown(found: ComparisonResult, arm: Arm) -> int | None:
    """Count the scenes that training has shown an arm and those it starts from.

    A scene that is read twice counts twice. None where an arm was not planned.
    """
    plans = {ran.arm_run.arm.name: ran.plan for ran in found.ran if ran.plan is not None}
    shown, at = 0, arm
    while True:
        if at.name not in plans:
            return None
        how = plans[at.name][TRAIN].settings["train"]
        shown += how.steps * how.batch_scenes
        if at.starts_from is None:
            return shown
        at = found.preset.arms[at.starts_from]


def _columns(found: ComparisonResult) -> dict[str, str]:
    """Scores of the table: their names, and the words above them."""
    ace = f"ace/{found.preset.count_error}_near"
    return {**SCORES, ace: "agent count error (ACE)", **_OFFICIAL}


def _numbers(found: ComparisonResult, arm: Arm) -> dict[str, Measured]:
    """Numbers of an arm's long rollouts, and Waymo's metric of its short ones."""
    official = {
        name: one
        for name, one in found.first(arm, OFFICIAL_PLAY).items()
        if name in _OFFICIAL
    }
    return {**found.first(arm, LONG), **official}


def _mean(found: ComparisonResult, arm: Arm, name: str) -> float:
    mean = _numbers(found, arm).get(name, Measured(None)).mean
    return math.nan if mean is None else mean
