"""How far a probability is to be trusted: what was predicted against what was logged."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float64

from infgen.views.charts.axes import NUM_COLOURS, Axis, dot, drawing, fit, grid, names, text

WIDTH_PX = 360.0
_LEFT_PX, _RIGHT_PX, _TOP_PX = 56.0, 22.0, 30.0
_PLOT_PX = WIDTH_PX - _LEFT_PX - _RIGHT_PX
_COUNTS_PX, _ROW_PX = 88.0, 16.0
_NUMBER_PX = 10.0
"""From one run's counts to the next's."""
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


def calibration_chart(runs: Mapping[str, Bins], *, title: str) -> str:
    """Draw the logged rate over the predicted one, bin by bin, with 95 % intervals.

    Below the diagonal too much was predicted. Below the axis stands how many decisions a
    bin holds; the last lines compare the overall rates.

    Args:
        runs: Bins by the name of the run.
        title: Of the chart.
    """
    bins = {name: found.filled() for name, found in runs.items()}
    bottom_px = _TOP_PX + _PLOT_PX
    x_axis, y_axis, marks = _axes(bins, bottom_px)
    last_px = bottom_px + _COUNTS_PX
    parts = [
        grid(x_axis, y_axis, marks, marks),
        names(x_axis, y_axis, "predicted rate", "logged rate"),
        f'<path class="diagonal" d="M{x_axis.from_px:g} {y_axis.from_px:g}'
        f'L{x_axis.to_px:g} {y_axis.to_px:g}"/>',
        text(_LEFT_PX - 6, bottom_px + 50, "count", "end"),
    ]
    for at, (name, found) in enumerate(bins.items()):
        parts.append(_points(found, at, x_axis, y_axis))
        parts.append(_counts(found, at, x_axis, bottom_px + 40 + _NUMBER_PX * at))
        parts.append(_overall(name, found, at, last_px + _ROW_PX * at))
    return drawing(WIDTH_PX, last_px + _ROW_PX * len(bins), title, parts)


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
    """Say in a line what was predicted, what happened, and how they compare."""
    count = max(1.0, float(bins.count.sum()))
    predicted, logged = (
        float(bins.predicted.sum()) / count,
        float(bins.happened.sum()) / count,
    )
    ratio = f"{predicted / logged:.3f}" if logged else "unknown"
    return f"predicted {predicted:.4f}, logged {logged:.4f}, ratio {ratio}"


def _axes(bins: Mapping[str, Bins], bottom_px: float) -> tuple[Axis, Axis, list[float]]:
    """One scale for both axes, logarithmic where rates are low."""
    rates = [
        np.stack([found.predicted / found.count, found.happened / found.count])
        for found in bins.values()
    ]
    known = np.concatenate([np.zeros(0), *[np.ravel(part) for part in rates]])
    known = known[known > 0]
    logarithmic = bool(len(known) and known.min() < _LOG_BELOW)
    ends = [] if logarithmic else [np.array([0.0, 1.0])]
    x_axis, marks = fit(
        [*rates, *ends], _LEFT_PX, WIDTH_PX - _RIGHT_PX, logarithmic=logarithmic
    )
    y_axis = Axis(x_axis.low, x_axis.high, bottom_px, _TOP_PX, logarithmic)
    return x_axis, y_axis, marks


def _points(bins: Bins, at: int, x_axis: Axis, y_axis: Axis) -> str:
    """Draw a dot per bin on its interval; a rate of nothing stands at the axis."""
    colour = f"c{at % NUM_COLOURS}"
    predicted, logged = bins.predicted / bins.count, bins.happened / bins.count
    parts = []
    for x, y, (low, high) in zip(
        predicted.tolist(),
        logged.tolist(),
        binomial_interval(bins.happened, bins.count).T.tolist(),
        strict=True,
    ):
        x_px, high = x_axis.px(x), min(high, y_axis.high)
        parts.append(
            f'<path class="line {colour}" '
            f'd="M{x_px:.1f} {y_axis.px(low):.1f}V{y_axis.px(high):.1f}"/>'
            + dot(x_px, y_axis.px(y), at, 3.5)
        )
    return "".join(parts)


def _counts(bins: Bins, at: int, x_axis: Axis, y_px: float) -> str:
    """Write how many decisions each bin holds, upwards, below its dot."""
    places = [x_axis.px(float(x)) for x in bins.predicted / bins.count]
    return "".join(
        f'<text class="small w{at % NUM_COLOURS}" text-anchor="end" '
        f'transform="translate({x_px + 3:.1f} {y_px:.1f}) rotate(-90)">'
        f"{escape(_short(count))}</text>"
        for x_px, count in zip(places, bins.count.tolist(), strict=True)
    )


def _short(count: float) -> str:
    """Write a count in few digits."""
    if count < 10_000:
        return f"{count:.0f}"
    return f"{count / 1e3:.3g}k" if count < 1e6 else f"{count / 1e6:.3g}M"


def _overall(name: str, bins: Bins, at: int, y_px: float) -> str:
    return dot(12.0, y_px - 4, at, 4.0) + text(24.0, y_px, f"{name}: {overall(bins)}")
