"""Charts as SVG: numbers in, a string out.

Colours, ink and fonts come from classes that ``page`` gives their values, light and dark;
lines differ by dash as well as by colour. Nothing is loaded from elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
    x_grid,
)

WIDTH_PX, HEIGHT_PX = 520.0, 300.0
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 58.0, 14.0, 34.0, 66.0
_LEGEND_ENTRY_PX = 150.0
_ROW_PX = 22.0
_LABELS_PX = 190.0


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
    """A measured number, where it may lie, and what it is held against.

    Attributes:
        name: Of the number.
        mean: Best guess.
        low: Lower end.
        high: Upper end.
        reference: Another number to compare with; NaN for none.
    """

    name: str
    mean: float
    low: float
    high: float
    reference: float


def line_chart(series: Sequence[Series], *, title: str, x_label: str, y_label: str) -> str:
    """Draw lines over a common x axis, with a legend below."""
    rows = -(-len(series) // _legend_columns())
    height = HEIGHT_PX + _ROW_PX * max(0, rows - 1)
    bottom_px = HEIGHT_PX - _BOTTOM_PX
    x_axis, x_marks = fit([line.x for line in series], _LEFT_PX, WIDTH_PX - _RIGHT_PX)
    y_axis, y_marks = fit([line.y for line in series], bottom_px, _TOP_PX)
    parts = [
        grid(x_axis, y_axis, x_marks, y_marks),
        names(x_axis, y_axis, x_label, y_label),
        *(_line(line, at, x_axis, y_axis) for at, line in enumerate(series)),
        *(_legend(line.name, at, bottom_px + 52) for at, line in enumerate(series)),
    ]
    return drawing(WIDTH_PX, height, title, parts)


def interval_chart(
    rows: Sequence[Interval], *, title: str, x_label: str, reference: str
) -> str:
    """Draw each number as a dot on its interval, what it is held against as a ring.

    Args:
        rows: The numbers, from top to bottom; those that are NaN stay empty.
        title: Of the chart.
        x_label: What the numbers are.
        reference: What the rings are.
    """
    values = [np.array([row.low, row.high, row.mean, row.reference]) for row in rows]
    height = _TOP_PX + _ROW_PX * len(rows) + _BOTTOM_PX
    bottom_px = height - _BOTTOM_PX
    axis, marks = fit([*values, np.zeros(1)], _LABELS_PX, WIDTH_PX - _RIGHT_PX)
    parts = [x_grid(axis, marks, _TOP_PX, bottom_px)]
    for at, row in enumerate(rows):
        parts.append(_interval(row, _TOP_PX + _ROW_PX * (at + 0.5), axis))
    key_px = bottom_px + 52
    parts += [
        text((_LABELS_PX + WIDTH_PX) / 2, bottom_px + 32, x_label, "middle"),
        f'<circle class="c0 dot" cx="{_LABELS_PX:g}" cy="{key_px - 4:g}" r="4"/>',
        text(_LABELS_PX + 10, key_px, "rollouts, 95 % interval"),
        f'<circle class="c1 ring" cx="{_LABELS_PX + 175:g}" cy="{key_px - 4:g}" r="4"/>',
        text(_LABELS_PX + 185, key_px, reference),
    ]
    return drawing(WIDTH_PX, height, title, parts)


def _line(line: Series, at: int, x_axis: Axis, y_axis: Axis) -> str:
    """Draw one line; a point between two gaps becomes a dot."""
    path, alone = line_path(line.x, line.y, x_axis, y_axis)
    colour = f"c{at % NUM_COLOURS} d{at % NUM_COLOURS}"
    dots = [dot(*place, at) for place in alone]
    return f'<path class="line {colour}" d="{path}"/>{"".join(dots)}'


def _interval(row: Interval, y_px: float, axis: Axis) -> str:
    parts = [text(_LABELS_PX - 10, y_px + 4, row.name, "end")]
    if np.isfinite(row.low) and np.isfinite(row.high):
        ends = f"M{axis.px(row.low):.1f} {y_px:g}H{axis.px(row.high):.1f}"
        parts.append(f'<path class="line c0" d="{ends}"/>')
    for value, look in ((row.reference, "c1 ring"), (row.mean, "c0 dot")):
        if np.isfinite(value):
            place = f'cx="{axis.px(value):.1f}" cy="{y_px:g}" r="4"'
            parts.append(f'<circle class="{look}" {place}/>')
    return "".join(parts)


def _legend_columns() -> int:
    return int((WIDTH_PX - _LEFT_PX) // _LEGEND_ENTRY_PX)


def _legend(name: str, at: int, y_px: float) -> str:
    row, column = divmod(at, _legend_columns())
    x_px, y_px = _LEFT_PX + column * _LEGEND_ENTRY_PX, y_px + row * _ROW_PX
    look = f"c{at % NUM_COLOURS} d{at % NUM_COLOURS}"
    return f'<path class="line {look}" d="M{x_px:g} {y_px - 4:g}h24"/>' + text(
        x_px + 30, y_px, name
    )
