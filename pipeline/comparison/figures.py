"""The figures of a comparison: how all methods change along their rollouts."""

import numpy as np
from jaxtyping import Float64

from infgen.clock import CLOCK
from infgen.views.charts.canvas import Chart
from infgen.views.charts.lines import Series, line_chart
from infgen.views.sheets import Sheet
from pipeline.comparison.claims import PROTOCOLS
from pipeline.comparison.learning_curve import learning_curve_charts
from pipeline.comparison.result import LONG, ComparisonResult
from pipeline.comparison.scores import Scored, middle_s
from pipeline.comparison.statistics import mean_curve
from pipeline.stages.report.tables import BUCKETS

X_LABEL = "middle of the window, s after now"
LOGS = "the logs"
_TRAFFIC = (
    ("agents/near", "Agents near the ego", "agents", 1.0),
    ("corrected/entry_rate", "Entries within 75 m", "per half second", CLOCK.token_s),
    ("corrected/exit_rate", "Exits within 75 m", "per half second", CLOCK.token_s),
)


def charts(found: ComparisonResult) -> list[Chart]:
    """Draw the count errors, the traffic, and each bucket's score, window by window."""
    return [
        chart
        for split, part in found.by_split.items()
        for chart in _charts(part, f" ({split})" if split else "")
    ]


def _charts(found: ComparisonResult, where: str) -> list[Chart]:
    ace = f"ace/{found.preset.count_error}_near"
    drawn = [_chart(found, ace, f"Agent count error (ACE){where}", "agents", logs=False)]
    drawn += [
        _chart(found, name, f"{title}{where}", unit, factor=factor)
        for name, title, unit, factor in _TRAFFIC
    ]
    drawn += [
        _chart(found, f"{protocol}/{name}", f"{label} ({protocol}){where}", "likelihood")
        for protocol in PROTOCOLS
        for name, label in {"composite": "composite", **BUCKETS}.items()
    ]
    curves = learning_curve_charts(found, where)
    return [*curves, *[chart for chart in drawn if chart is not None]]


def curve_sheet(found: ComparisonResult) -> Sheet:
    """All that the figures show, as numbers: a row per method, metric and window."""
    names = [f"ace/{found.preset.count_error}_near", *[name for name, *_ in _TRAFFIC]]
    names += [f"{each}/{name}" for each in PROTOCOLS for name in ("composite", *BUCKETS)]
    rows: list[list[str | float | None]] = []
    for split, part in found.by_split.items():
        where = f", {split}" if split else ""
        for name in names:
            logged = _logged(part, name)
            for line in [*_lines(part, name), *([] if logged is None else [logged])]:
                for x, y in zip(line.x.tolist(), line.y.tolist(), strict=True):
                    value = None if np.isnan(y) else y
                    rows.append([f"{line.name}{where}", name, x, value])
    columns = ["method", "metric", "middle of the window, s", "mean"]
    return Sheet("curves", "Curves", columns, rows)


def _chart(
    found: ComparisonResult,
    name: str,
    title: str,
    unit: str,
    *,
    factor: float = 1.0,
    logs: bool = True,
) -> Chart | None:
    lines = [_scaled(line, factor) for line in _lines(found, name)]
    if not lines:
        return None
    logged = _logged(found, name) if logs else None
    return line_chart(
        lines,
        None if logged is None else _scaled(logged, factor),
        title=f"{title} by window",
        x_label=X_LABEL,
        y_label=unit,
    )


def _lines(found: ComparisonResult, name: str) -> list[Series]:
    """One line per arm and long rollout set: the mean over its seeds."""
    lines = []
    for arm in found.arms:
        rollout_sets = found.runs(arm, LONG)
        for rollout_set, runs in rollout_sets.items():
            curves = [curve for one in runs if (curve := _curve(one, name)) is not None]
            if curves:
                mean = mean_curve(curves)
                label = (
                    arm.label if len(rollout_sets) == 1 else f"{arm.label}, {rollout_set}"
                )
                lines.append(Series(label, middle_s(runs[0].measures, len(mean)), mean))
    return lines


def _logged(found: ComparisonResult, name: str) -> Series | None:
    """The same of the logs that were continued; None without any."""
    curve = found.logs.curves().get(name)
    if curve is None or np.isnan(curve.value).all():
        return None
    return Series(LOGS, middle_s(found.scored[0].measures, len(curve.value)), curve.value)


def _curve(one: Scored, name: str) -> Float64[np.ndarray, " window"] | None:
    """Mean over one run's rollouts; None where no window has a value."""
    curve = one.tally.curves().get(name)
    if curve is None or np.isnan(curve.value).all():
        return None
    return curve.value


def _scaled(line: Series, factor: float) -> Series:
    return Series(line.name, line.x, line.y * factor)
