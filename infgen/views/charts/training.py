"""How training went: every figure of the log over the steps, several runs in one chart.

A run has one colour. What was measured while training is noisy, so a bold line is its
running mean, with the span of the single values pale behind it; what the held-out scenes
say is dashed, with a dot where it was measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from infgen.views.charts.calibration import Bins, calibration_chart
from infgen.views.charts.canvas import COLOURS, DASHES, INK, Chart, set_logarithmic
from infgen.views.charts.lines import LEGEND_ROW_PX, Series, draw_legend

_WIDTH_PX, _PLOT_PX = 360.0, 162.0
_LEFT_PX, _RIGHT_PX, _TOP_PX, _LABEL_PX = 60.0, 18.0, 34.0, 46.0
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


def training_charts(runs: Sequence[Run]) -> list[Chart]:
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


def calibration_charts(runs: Sequence[Run]) -> list[Chart]:
    """Draw how far to trust the probabilities of leaving and of adding."""
    drawn = []
    for term, event in _EVENTS.items():
        bins = {run.name: run.bins[term] for run in runs if term in run.bins}
        if bins:
            drawn.append(calibration_chart(bins, title=f"{event}: predicted and logged"))
    return drawn


def figure_chart(runs: Sequence[Run], figure: str, title: str, y_label: str) -> Chart:
    """Draw one figure of all runs that logged it, train and validation."""
    logged = {
        at: run
        for at, run in enumerate(runs)
        if figure in run.train or figure in run.validation
    }
    low, high, logarithmic = _limits(list(logged.values()), figure)

    def draw(axes: Axes) -> None:
        if logarithmic:
            set_logarithmic(axes)
        axes.set(ylim=(low, high), xlabel="step", ylabel=y_label)
        axes.plot([], [], color=INK, label="training, running mean")
        axes.plot([], [], color=INK, linestyle=DASHES[2], label="held-out")
        for at, run in logged.items():
            _draw_run(axes, run, figure, COLOURS[at % len(COLOURS)])
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        draw_legend(axes, _PLOT_PX)

    bottom_px = _LABEL_PX + LEGEND_ROW_PX * (1 + -(-len(logged) // 2))
    margins_px = (_LEFT_PX, _RIGHT_PX, _TOP_PX, bottom_px)
    return Chart(title, draw, _WIDTH_PX, _TOP_PX + _PLOT_PX + bottom_px, margins_px)


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


def _limits(runs: Sequence[Run], figure: str) -> tuple[float, float, bool]:
    """Ends of the y axis, for all lines and nearly all values; whether logarithmic."""
    lines = [run.smoothed(figure).y for run in runs if figure in run.train]
    lines += [run.validation[figure].y for run in runs if figure in run.validation]
    smooth = _known(lines)
    singles = [_known([run.train[figure].y]) for run in runs if figure in run.train]
    ends = [np.quantile(each, [_OUTLIERS, 1 - _OUTLIERS]) for each in singles if len(each)]
    found = _known([smooth, *ends])
    if not len(found):
        return 0.0, 1.0, False
    low, high = float(found.min()), float(found.max())
    falls = 0 < _LOG_FROM * smooth.min() < smooth.max()
    if falls and figure not in _ALWAYS_LINEAR:
        return float(found[found > 0].min()) / 1.2, high * 1.2, True
    room = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
    return low - room, high + room, False


def _known(parts: Sequence[np.ndarray]) -> Float64[np.ndarray, " known"]:
    values = np.concatenate([np.zeros(0), *parts])
    return values[np.isfinite(values)]


def _draw_run(axes: Axes, run: Run, figure: str, colour: str) -> None:
    """Draw the span of single values, their running mean, and what validations found."""
    axes.plot([], [], color=colour, label=run.name)
    if figure in run.train:
        _draw_spans(axes, run.train[figure], colour)
        line = _thinned(run.smoothed(figure))
        axes.plot(line.x, line.y, color=colour)
    if figure in run.validation:
        line = run.validation[figure]
        dashed = Line2D(
            line.x, line.y, color=colour, linestyle=DASHES[2], marker="o", ms=5, mew=0
        )
        axes.add_line(dashed)


def _draw_spans(axes: Axes, line: Series, colour: str) -> None:
    """Shade between the least and the greatest value, stretch by stretch."""
    known = np.isfinite(line.y)
    x, y = line.x[known], line.y[known]
    if not len(x):
        return
    parts = np.array_split(np.arange(len(x)), min(_SPANS, len(x)))
    middle = np.array([x[part].mean() for part in parts])
    low = np.array([y[part].min() for part in parts])
    high = np.array([y[part].max() for part in parts])
    axes.fill_between(middle, low, high, color=colour, alpha=0.16, linewidth=0)


def _thinned(line: Series) -> Series:
    """Keep no more points than can be told apart, first and last among them."""
    most = min(2 * _SPANS, len(line.x))
    kept = np.unique(np.linspace(0, len(line.x) - 1, most).round().astype(int))
    return Series(line.name, line.x[kept], line.y[kept])
