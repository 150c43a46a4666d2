"""How training went: every figure of the log over the steps, several runs in one chart.

A run has one colour. What was measured while training is noisy, so a bold line is its
running mean, with the span of the single values pale behind it; what the held-out scenes
say is dashed, with a dot where it was measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from infgen.views.charts.axes import (
    NUM_COLOURS,
    Axis,
    dot,
    drawing,
    fit,
    grid,
    line_path,
    names,
    text,
)
from infgen.views.charts.calibration import Bins, calibration_chart
from infgen.views.charts.figures import Series

WIDTH_PX, HEIGHT_PX = 360.0, 262.0
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 56.0, 22.0, 30.0, 70.0
_LEGEND_PX, _COLUMN_PX = 16.0, 180.0
_NEAR, _MOST_NEAR = 4, 1 / 10
"""A running mean reaches so many values to either side ..."""
_NEAR_SHARE = 1 / 40
"""... or this share of all values if that is more, but never beyond the share above."""
_SPANS = 150
"""So many spans of single values at most; more could not be told apart."""
_LOG_FROM = 10.0
"""A loss that falls to less than a tenth is drawn on a logarithmic axis."""
_ALWAYS_LINEAR = {"learning_rate", "motion_accuracy"}
_OUTLIERS = 0.02
"""Share of single values, at either end, that may lie beyond the axis."""

LOSSES = {
    "motion": "Motion token",
    "keep": "Keep or remove",
    "add": "Add or begin motion",
    "position": "Position token (cell)",
    "position_regression": "Position (regressed)",
    "heading": "Heading token",
    "offset": "Offset in the cell",
    "agent_type": "Agent type of an insertion",
    "size": "Size of an insertion",
    "validity_pattern": "Validity pattern",
    "map": "Hidden map token",
}
"""Terms of the loss, in the order in which they are drawn; others follow."""
_SQUARED = {"size", "offset", "position_regression"}
"""Terms that are squared errors whatever the network."""
_OTHERS = {
    "motion_accuracy": ("Accuracy of motion tokens", "share right"),
    "motion_perplexity": ("Perplexity of motion tokens", "tokens"),
    "gradient_norm": ("Norm of the gradient", "norm"),
    "learning_rate": ("Learning rate", ""),
}
_EVENTS = {"keep": "Removal", "add": "Insertion"}
"""Decisions with probabilities, and what happens where they say yes."""


@dataclass(frozen=True, slots=True)
class Run:
    """What the log of one training run says.

    Attributes:
        name: Of the run, in legends.
        train: Figures of the steps by name, x being the step.
        weight: What each figure's values are means over, by the figure's name.
        validation: Figures of the held-out scenes by name.
        bins: Reliability of the last validation's decisions, by the name of the term.
    """

    name: str
    train: Mapping[str, Series]
    weight: Mapping[str, Float64[np.ndarray, " point"]] = field(default_factory=dict)
    validation: Mapping[str, Series] = field(default_factory=dict)
    bins: Mapping[str, Bins] = field(default_factory=dict)

    def smoothed(self, figure: str) -> Series:
        """Running mean of one figure, each value weighted by what it is a mean over."""
        line = self.train[figure]
        weight = self.weight.get(figure, np.ones(len(line.y)))
        return Series(line.name, line.x, running_mean(line.y, weight))


def training_charts(runs: Sequence[Run]) -> list[str]:
    """Draw every figure that any run logged: terms of the loss, accuracy, calibration."""
    logged = {name for run in runs for name in (*run.train, *run.validation)}
    losses = [name for name in LOSSES if name in logged]
    drawn = [figure_chart(runs, name, LOSSES[name], _unit(runs, name)) for name in losses]
    if "total" in logged:
        drawn.append(figure_chart(runs, "total", "All terms, weighted", "loss"))
    drawn += [
        figure_chart(runs, name, *words)
        for name, words in _OTHERS.items()
        if name in logged
    ]
    return drawn + calibration_charts(runs)


def _unit(runs: Sequence[Run], term: str) -> str:
    """Say what a term is measured in: nats where a token is chosen in every run."""
    if term in _SQUARED:
        return "squared error"
    logging = [run for run in runs if term in run.train]
    chosen = all(
        f"{term}_accuracy" in run.train or f"{term}_predicted" in run.train
        for run in logging
    )
    return "loss, nats" if chosen else "loss"


def calibration_charts(runs: Sequence[Run]) -> list[str]:
    """Draw how far to trust the probabilities of leaving and of adding."""
    drawn = []
    for term, event in _EVENTS.items():
        bins = {run.name: run.bins[term] for run in runs if term in run.bins}
        if bins:
            drawn.append(calibration_chart(bins, title=f"{event}: predicted and logged"))
    return drawn


def figure_chart(runs: Sequence[Run], figure: str, title: str, y_label: str) -> str:
    """Draw one figure of all runs that logged it, train and validation."""
    logged = {
        at: run
        for at, run in enumerate(runs)
        if figure in run.train or figure in run.validation
    }
    height = HEIGHT_PX + _LEGEND_PX * -(-len(logged) // 2)
    x_axis, x_marks, y_axis, y_marks = _axes(list(logged.values()), figure)
    parts = [
        grid(x_axis, y_axis, x_marks, y_marks),
        names(x_axis, y_axis, "step", y_label),
    ]
    for at, run in logged.items():
        if figure in run.train:
            parts.append(_spans(run.train[figure], at, x_axis, y_axis))
    for at, run in logged.items():
        if figure in run.train:
            parts.append(_curve(_thinned(run.smoothed(figure)), at, x_axis, y_axis))
        if figure in run.validation:
            parts.append(_measured(run.validation[figure], at, x_axis, y_axis))
    parts.append(_legend({at: run.name for at, run in logged.items()}, HEIGHT_PX - 14))
    return drawing(WIDTH_PX, height, title, parts)


def running_mean(
    values: Float64[np.ndarray, " point"], weight: Float64[np.ndarray, " point"]
) -> Float64[np.ndarray, " point"]:
    """Weighted mean [point] around each point; unknown where nothing around is known."""
    reach = int(min(max(_NEAR, len(values) * _NEAR_SHARE), len(values) * _MOST_NEAR))
    known = np.isfinite(values) & (weight > 0)
    sums = np.zeros((2, len(values) + 1))
    sums[0, 1:] = np.cumsum(np.where(known, values * weight, 0.0))
    sums[1, 1:] = np.cumsum(np.where(known, weight, 0.0))
    at = np.arange(len(values))
    ends = np.minimum(at + reach + 1, len(values))
    total, share = sums[:, ends] - sums[:, np.maximum(at - reach, 0)]
    return np.divide(total, share, out=np.full(len(values), np.nan), where=share > 0)


def _axes(runs: Sequence[Run], figure: str) -> tuple[Axis, list[float], Axis, list[float]]:
    """Scales and ticks that all lines lie on, and nearly all single values."""
    found = [run.train[figure] for run in runs if figure in run.train]
    lines = [run.smoothed(figure) for run in runs if figure in run.train]
    lines += [run.validation[figure] for run in runs if figure in run.validation]
    values = [line.y for line in lines]
    smooth = np.concatenate([np.zeros(0), *values])
    smooth = smooth[np.isfinite(smooth)]
    falls = bool(len(smooth) and 0 < _LOG_FROM * smooth.min() < smooth.max())
    logarithmic = falls and figure not in _ALWAYS_LINEAR
    for line in found:
        known = line.y[np.isfinite(line.y)]
        if len(known):
            values.append(np.quantile(known, [_OUTLIERS, 1 - _OUTLIERS]))
    x_axis, x_marks = fit(
        [line.x for line in lines], _LEFT_PX, WIDTH_PX - _RIGHT_PX, most=5
    )
    y_axis, y_marks = fit(values, HEIGHT_PX - _BOTTOM_PX, _TOP_PX, logarithmic=logarithmic)
    return x_axis, x_marks, y_axis, y_marks


def _spans(line: Series, at: int, x_axis: Axis, y_axis: Axis) -> str:
    """Draw between which values a figure lies, stretch by stretch."""
    known = np.isfinite(line.y)
    x, y = line.x[known], np.clip(line.y[known], y_axis.low, y_axis.high)
    parts = np.array_split(np.arange(len(x)), min(_SPANS, len(x)) or 1)
    if not len(x):
        return ""
    middle = np.array([x[part].mean() for part in parts])
    low = np.array([y[part].min() for part in parts])
    high = np.array([y[part].max() for part in parts])
    outline = np.concatenate([middle, middle[::-1]]), np.concatenate([high, low[::-1]])
    path, _ = line_path(*outline, x_axis, y_axis)
    return f'<path class="band c{at % NUM_COLOURS}" d="{path}Z"/>'


def _curve(line: Series, at: int, x_axis: Axis, y_axis: Axis) -> str:
    path, _ = line_path(line.x, line.y, x_axis, y_axis)
    return f'<path class="line c{at % NUM_COLOURS}" d="{path}"/>'


def _measured(line: Series, at: int, x_axis: Axis, y_axis: Axis) -> str:
    """Draw a dashed line with a dot at every known point."""
    path, _ = line_path(line.x, line.y, x_axis, y_axis)
    dots = [
        dot(x_axis.px(x), y_axis.px(y), at, 2.5)
        for x, y in zip(line.x.tolist(), line.y.tolist(), strict=True)
        if np.isfinite(y)
    ]
    return f'<path class="line c{at % NUM_COLOURS} d2" d="{path}"/>{"".join(dots)}'


def _thinned(line: Series) -> Series:
    """Keep no more points than can be told apart, first and last among them."""
    most = min(2 * _SPANS, len(line.x))
    kept = np.unique(np.linspace(0, len(line.x) - 1, most).round().astype(int))
    return Series(line.name, line.x[kept], line.y[kept])


def _legend(runs: Mapping[int, str], y_px: float) -> str:
    """Say what bold and dashed lines are, and whose the colours are."""
    second_px = _LEFT_PX + _COLUMN_PX
    parts = [
        f'<path class="line inked" d="M{_LEFT_PX:g} {y_px - 4:g}h24"/>',
        text(_LEFT_PX + 30, y_px, "training, running mean"),
        f'<path class="line inked d2" d="M{second_px:g} {y_px - 4:g}h24"/>',
        text(second_px + 30, y_px, "held-out"),
    ]
    for place, (at, name) in enumerate(runs.items()):
        row, column = divmod(place, 2)
        x_px, row_px = _LEFT_PX + _COLUMN_PX * column, y_px + _LEGEND_PX * (row + 1)
        parts.append(
            f'<path class="line c{at % NUM_COLOURS}" d="M{x_px:g} {row_px - 4:g}h24"/>'
            + text(x_px + 30, row_px, name)
        )
    return "".join(parts)
