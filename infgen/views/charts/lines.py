"""Lines over a common axis, and numbers on their intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from infgen.views.charts.canvas import COLOURS, DASHES, INK, PAPER, Chart, set_logarithmic

_WIDTH_PX, _PLOT_PX = 520.0, 200.0
_LEFT_PX, _RIGHT_PX, _TOP_PX, _LABEL_PX = 62.0, 14.0, 34.0, 46.0
_LEGEND_COLUMNS, LEGEND_ROW_PX = 2, 18.0
_NAMES_PX, _ROW_PX = 190.0, 22.0


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a chart.

    Attributes:
        name: In the legend.
        x: Of its points.
        y: Of its points; the line breaks where it is NaN.
    """

    name: str
    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]


@dataclass(frozen=True, slots=True)
class Interval:
    """A measured number, its interval, and a number to compare it with.

    Attributes:
        name: Of the number.
        mean: Best guess.
        low: Lower end.
        high: Upper end.
        reference: The other number; NaN for none.
    """

    name: str
    mean: float
    low: float
    high: float
    reference: float


def line_chart(
    lines: Sequence[Series],
    truth: Series | None = None,
    *,
    title: str,
    x_label: str,
    y_label: str,
    log_x: bool = False,
) -> Chart:
    """Draw lines over a common x axis, each with its own colour and dash.

    Args:
        lines: One per method; more than there are colours differ by their dashes.
        truth: What happened, or what is best possible; drawn in ink.
        title: Of the chart.
        x_label: Below it.
        y_label: Beside it.
        log_x: Whether the axis is logarithmic, with a dot at every point.
    """

    def draw(axes: Axes) -> None:
        if log_x:
            set_logarithmic(axes, x=True, y=False)
        for at, line in enumerate(lines):
            dash = DASHES[(at + at // len(COLOURS)) % len(DASHES)]
            _draw_line(axes, line, COLOURS[at % len(COLOURS)], dash)
            if log_x:
                axes.plot(line.x, line.y, "o", color=COLOURS[at % len(COLOURS)], ms=4.0)
        if truth is not None:
            _draw_line(axes, truth, INK, DASHES[0])
        axes.set(xlabel=x_label, ylabel=y_label)
        draw_legend(axes, _PLOT_PX)

    rows = -(-(len(lines) + (truth is not None)) // _LEGEND_COLUMNS)
    bottom_px = _LABEL_PX + LEGEND_ROW_PX * rows
    margins_px = (_LEFT_PX, _RIGHT_PX, _TOP_PX, bottom_px)
    return Chart(title, draw, _WIDTH_PX, _TOP_PX + _PLOT_PX + bottom_px, margins_px)


def interval_chart(
    rows: Sequence[Interval], *, title: str, x_label: str, reference: str
) -> Chart:
    """Draw each number as a dot on its interval, its reference as a ring.

    Args:
        rows: The numbers, from top to bottom; those that are NaN stay empty.
        title: Of the chart.
        x_label: What the numbers are.
        reference: What the rings are.
    """
    mean, low, high, other = np.array(
        [[row.mean, row.low, row.high, row.reference] for row in rows], np.float64
    ).reshape(-1, 4).T  # fmt: skip
    at = np.arange(len(rows))
    plot_px = _ROW_PX * max(1, len(rows))

    def draw(axes: Axes) -> None:
        axes.hlines(at, low, high, color=COLOURS[0])
        (rings,) = axes.plot(other, at, "o", color=COLOURS[1], ms=7.0, label=reference)
        rings.set(markerfacecolor=PAPER, markeredgewidth=1.8)
        axes.plot(mean, at, "o", color=COLOURS[0], ms=7.0, label="rollouts, 95 % interval")
        axes.set_yticks(at, [row.name for row in rows])
        axes.set_ylim(max(1, len(rows)) - 0.5, -0.5)
        axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(x_label)
        draw_legend(axes, plot_px)

    bottom_px = _LABEL_PX + LEGEND_ROW_PX
    margins_px = (_NAMES_PX, _RIGHT_PX, _TOP_PX, bottom_px)
    return Chart(title, draw, _WIDTH_PX, _TOP_PX + plot_px + bottom_px, margins_px)


def draw_legend(axes: Axes, plot_px: float, *, fontsize: float = 11.0) -> None:
    """Name what was drawn, in two columns below the axes and their labels."""
    handles, _ = axes.get_legend_handles_labels()
    if not handles:
        return
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(0.0, -(_LABEL_PX - 8) / plot_px),
        ncols=_LEGEND_COLUMNS,
        fontsize=fontsize,
        borderaxespad=0.0,
        borderpad=0.0,
    )


def _draw_line(axes: Axes, line: Series, colour: str, dash: object) -> None:
    """Draw one line; a point between two gaps becomes a dot."""
    axes.plot(line.x, line.y, color=colour, linestyle=dash, label=line.name)
    known = np.pad(np.isfinite(line.x) & np.isfinite(line.y), 1)
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    axes.plot(line.x[alone], line.y[alone], "o", color=colour, ms=6.0)
