"""How far a probability is to be trusted: predicted rates against logged rates."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes

from infgen.views.charts.canvas import COLOURS, QUIET, Chart, set_logarithmic

_WIDTH_PX = 360.0
_LEFT_PX, _RIGHT_PX, _TOP_PX = 60.0, 18.0, 34.0
_PLOT_PX = _WIDTH_PX - _LEFT_PX - _RIGHT_PX
_COUNTS_PX, _ROW_PX, _COUNT_PX = 88.0, 16.0, 9.0
_LOG_BELOW = 0.05
"""Rates as low as this ask for logarithmic axes."""
NORMAL_95 = 1.959963984540054
"""A normal deviate lies within so many standard deviations 19 times out of 20."""


@dataclass(frozen=True, slots=True)
class Bins:
    """Decisions, sorted into bins by their predicted probability.

    Attributes:
        count: Decisions in each bin.
        predicted: Sum of their probabilities.
        happened: How many of them came out yes.
    """

    count: Float64[np.ndarray, " bin"]
    predicted: Float64[np.ndarray, " bin"]
    happened: Float64[np.ndarray, " bin"]

    def filled(self) -> "Bins":
        """Leave out empty bins."""
        rows = self.count > 0
        return Bins(self.count[rows], self.predicted[rows], self.happened[rows])


def calibration_chart(runs: Mapping[str, Bins], *, title: str) -> Chart:
    """Draw the logged rate over the predicted one, bin by bin, with 95 % intervals.

    A bin below the diagonal was predicted too often. Numbers below the axis count the
    decisions of each bin; the last lines compare the overall rates.

    Args:
        runs: Bins by the name of the run.
        title: Of the chart.
    """
    bins = {name: found.filled() for name, found in runs.items()}
    low, high, logarithmic = _limits(bins)

    def draw(axes: Axes) -> None:
        if logarithmic:
            set_logarithmic(axes, x=True)
        axes.set(xlim=(low, high), ylim=(low, high))
        axes.plot([low, high], [low, high], color=QUIET, lw=1, ls=(0, (4, 3)))
        axes.set(xlabel="predicted rate", ylabel="logged rate")
        axes.xaxis.labelpad = 28.0  # The counts stand above the label.
        for at, (name, found) in enumerate(bins.items()):
            _draw_bins(axes, found, at)
            _draw_overall(axes, f"{name}: {overall(found)}", at)

    bottom_px = _COUNTS_PX + _ROW_PX * len(bins)
    margins_px = (_LEFT_PX, _RIGHT_PX, _TOP_PX, bottom_px)
    return Chart(title, draw, _WIDTH_PX, _TOP_PX + _PLOT_PX + bottom_px, margins_px)


def binomial_interval(
    happened: Float64[np.ndarray, " bin"], count: Float64[np.ndarray, " bin"]
) -> Float64[np.ndarray, "2 bin"]:
    """Lower and upper end of the rate behind so many of so many (Wilson, 95 %)."""
    rate, square = happened / count, NORMAL_95**2
    middle = (rate + square / (2 * count)) / (1 + square / count)
    spread = np.sqrt(rate * (1 - rate) / count + square / (4 * count**2))
    half = NORMAL_95 * spread / (1 + square / count)
    return np.clip(np.stack([middle - half, middle + half]), 0.0, 1.0)


def overall(bins: Bins) -> str:
    """Compare the predicted and the logged rate of all decisions in one line."""
    count = max(1.0, float(bins.count.sum()))
    predicted, logged = (
        float(bins.predicted.sum()) / count,
        float(bins.happened.sum()) / count,
    )
    ratio = f"{predicted / logged:.3f}" if logged else "unknown"
    return f"predicted {predicted:.4f}, logged {logged:.4f}, ratio {ratio}"


def _limits(bins: Mapping[str, Bins]) -> tuple[float, float, bool]:
    """Ends of both axes; logarithmic where rates are low."""
    sums = [(each.predicted, each.happened, each.count) for each in bins.values()]
    rates = np.concatenate(
        [np.zeros(0), *(part / count for *parts, count in sums for part in parts)]
    )
    known = rates[rates > 0]
    if not len(known) or known.min() >= _LOG_BELOW:
        return 0.0, 1.0, False
    low, high = known.min() / 1.5, min(1.0, known.max() * 1.5)
    return float(low), float(high), True


def _draw_bins(axes: Axes, bins: Bins, at: int) -> None:
    """Draw a dot per bin on its interval; a rate of zero stands at the axis."""
    colour = COLOURS[at % len(COLOURS)]
    predicted = bins.predicted / bins.count
    logged = np.maximum(bins.happened / bins.count, axes.get_ylim()[0])
    interval = np.clip(binomial_interval(bins.happened, bins.count), *axes.get_ylim())
    axes.vlines(predicted, *interval, color=colour)
    axes.plot(predicted, logged, "o", color=colour, ms=6, clip_on=False)
    for x, count in zip(predicted.tolist(), bins.count.tolist(), strict=True):
        axes.annotate(
            _short(count),
            (x, 0.0),
            (_COUNT_PX * at, -20.0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            ha="center",
            va="top",
            fontsize=9,
            color=colour,
        )


def _draw_overall(axes: Axes, words: str, at: int) -> None:
    """Write a line below the axes, in the colour of its run."""
    y_px = -(_COUNTS_PX - 22.0) - _ROW_PX * at
    axes.annotate(
        f"● {words}",
        (0.0, 0.0),
        (-_LEFT_PX + 8.0, y_px),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=9,
        va="top",
        color=COLOURS[at % len(COLOURS)],
    )


def _short(count: float) -> str:
    """Write a count in few digits."""
    if count < 10_000:
        return f"{count:.0f}"
    return f"{count / 1e3:.3g}k" if count < 1e6 else f"{count / 1e6:.3g}M"
