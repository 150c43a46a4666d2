"""Several methods in one chart, and the truth in ink beside them."""

from collections.abc import Sequence

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
from infgen.views.charts.figures import Series

WIDTH_PX, PLOT_PX = 520.0, 236.0
_LEFT_PX, _RIGHT_PX, _TOP_PX = 58.0, 14.0, 34.0
_LEGEND_PX, _ROW_PX, _COLUMNS = 52.0, 20.0, 2
_MARGIN_PX = 10.0
_INK = "inked"


def comparison_chart(
    lines: Sequence[Series],
    truth: Series | None = None,
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> str:
    """Draw a line per method, each with its own colour and dash, over a common x axis.

    Args:
        lines: Of the methods; more than there are colours differ by their dashes.
        truth: What happened, or what is best possible; drawn in ink.
        title: Of the chart.
        x_label: Below it.
        y_label: Beside it.
    """
    every = [*lines, *([] if truth is None else [truth])]
    x_axis, x_marks = fit([line.x for line in every], _LEFT_PX, WIDTH_PX - _RIGHT_PX)
    y_axis, y_marks = fit([line.y for line in every], PLOT_PX, _TOP_PX)
    looks = [_look(at) for at in range(len(lines))]
    looks += [] if truth is None else [_INK]
    parts = [
        grid(x_axis, y_axis, x_marks, y_marks),
        names(x_axis, y_axis, x_label, y_label),
    ]
    for at, (line, look) in enumerate(zip(every, looks, strict=True)):
        parts += [_line(line, look, at, x_axis, y_axis), _legend(line.name, look, at)]
    rows = -(-len(every) // _COLUMNS)
    height_px = PLOT_PX + _LEGEND_PX + _ROW_PX * max(0, rows - 1) + _MARGIN_PX
    return drawing(WIDTH_PX, height_px, title, parts)


def _look(at: int) -> str:
    """Colour and dash; no two are alike among as many lines as there are pairs."""
    return f"c{at % NUM_COLOURS} d{(at + at // NUM_COLOURS) % NUM_COLOURS}"


def _line(line: Series, look: str, at: int, x_axis: Axis, y_axis: Axis) -> str:
    path, alone = line_path(line.x, line.y, x_axis, y_axis)
    dots = [_ring(*place) if look == _INK else dot(*place, at) for place in alone]
    return f'<path class="line {look}" d="{path}"/>{"".join(dots)}'


def _ring(x_px: float, y_px: float) -> str:
    return f'<circle class="{_INK} ring" cx="{x_px:.1f}" cy="{y_px:.1f}" r="4"/>'


def _legend(name: str, look: str, at: int) -> str:
    row, column = divmod(at, _COLUMNS)
    x_px = _LEFT_PX + column * (WIDTH_PX - _LEFT_PX) / _COLUMNS
    y_px = PLOT_PX + _LEGEND_PX + row * _ROW_PX
    return f'<path class="line {look}" d="M{x_px:g} {y_px - 4:g}h24"/>' + text(
        x_px + 30, y_px, name
    )
