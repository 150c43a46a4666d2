"""Charts as SVG: numbers in, a string out.

Colours, ink and fonts come from classes that ``page`` gives their values, light and dark;
lines differ by dash as well as by colour. Nothing is loaded from elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

WIDTH_PX, HEIGHT_PX = 520.0, 300.0
NUM_COLOURS = 6
"""Colours that a page defines: classes ``c0`` and so on."""
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


@dataclass(frozen=True, slots=True)
class _Axis:
    """A scale from values to pixels."""

    low: float
    high: float
    from_px: float
    to_px: float

    def px(self, value: float) -> float:
        """Place a value."""
        share = (value - self.low) / (self.high - self.low)
        return self.from_px + share * (self.to_px - self.from_px)


def line_chart(series: Sequence[Series], *, title: str, x_label: str, y_label: str) -> str:
    """Draw lines over a common x axis, with a legend below."""
    x_low, x_high = _limits([line.x for line in series])
    y_low, y_high = _limits([line.y for line in series])
    x_ticks, y_ticks = ticks(x_low, x_high), ticks(y_low, y_high)
    rows = -(-len(series) // _legend_columns())
    height = HEIGHT_PX + _ROW_PX * max(0, rows - 1)
    bottom_px = HEIGHT_PX - _BOTTOM_PX
    x_axis = _Axis(
        min(x_low, x_ticks[0]), max(x_high, x_ticks[-1]), _LEFT_PX, WIDTH_PX - _RIGHT_PX
    )
    y_axis = _Axis(min(y_low, y_ticks[0]), max(y_high, y_ticks[-1]), bottom_px, _TOP_PX)
    parts = [
        _grid(x_axis, y_axis, x_ticks, y_ticks),
        _text((_LEFT_PX + WIDTH_PX) / 2, bottom_px + 32, x_label, "middle"),
        f'<text class="ink" transform="translate(14 {(bottom_px + _TOP_PX) / 2:g}) '
        f'rotate(-90)" text-anchor="middle">{escape(y_label)}</text>',
        *(_line(line, at, x_axis, y_axis) for at, line in enumerate(series)),
        *(_legend(line.name, at, bottom_px + 52) for at, line in enumerate(series)),
    ]
    return _svg(WIDTH_PX, height, title, parts)


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
    low, high = _limits([*values, np.zeros(1)])
    marks = ticks(low, high)
    height = _TOP_PX + _ROW_PX * len(rows) + _BOTTOM_PX
    bottom_px = height - _BOTTOM_PX
    axis = _Axis(min(low, marks[0]), max(high, marks[-1]), _LABELS_PX, WIDTH_PX - _RIGHT_PX)
    parts = [_x_grid(axis, marks, _TOP_PX, bottom_px)]
    for at, row in enumerate(rows):
        parts.append(_interval(row, _TOP_PX + _ROW_PX * (at + 0.5), axis))
    key_px = bottom_px + 52
    parts += [
        _text((_LABELS_PX + WIDTH_PX) / 2, bottom_px + 32, x_label, "middle"),
        f'<circle class="c0 dot" cx="{_LABELS_PX:g}" cy="{key_px - 4:g}" r="4"/>',
        _text(_LABELS_PX + 10, key_px, "rollouts, 95 % interval"),
        f'<circle class="c1 ring" cx="{_LABELS_PX + 175:g}" cy="{key_px - 4:g}" r="4"/>',
        _text(_LABELS_PX + 185, key_px, reference),
    ]
    return _svg(WIDTH_PX, height, title, parts)


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Choose round numbers that span a range: steps of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / (most - 1)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(
        power * part for part in (1, 2, 5, 10) if power * part >= rough * (1 - 1e-9)
    )
    first, last = np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9)
    return [float(round(step * at, 10)) for at in np.arange(first, last + 1)]


def _limits(values: Sequence[Float[np.ndarray, "..."]]) -> tuple[float, float]:
    """Least and greatest known value, apart even where there is one only, or none."""
    known = np.concatenate([np.zeros(0), *values])
    known = known[np.isfinite(known)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    if high - low < 1e-9 * max(1.0, abs(high)):
        pad = 0.5 * abs(high) or 0.5
        low, high = low - pad, high + pad
    return low, high


def _grid(
    x_axis: _Axis, y_axis: _Axis, x_ticks: Sequence[float], y_ticks: Sequence[float]
) -> str:
    lines = [_x_grid(x_axis, x_ticks, y_axis.to_px, y_axis.from_px)]
    for value in y_ticks:
        y_px = y_axis.px(value)
        lines.append(
            f'<path class="grid" d="M{x_axis.from_px:g} {y_px:.1f}H{x_axis.to_px:g}"/>'
            + _text(x_axis.from_px - 6, y_px + 4, f"{value:g}", "end")
        )
    return "".join(lines)


def _x_grid(axis: _Axis, marks: Sequence[float], top_px: float, bottom_px: float) -> str:
    lines = []
    for value in marks:
        x_px = axis.px(value)
        lines.append(
            f'<path class="grid" d="M{x_px:.1f} {top_px:g}V{bottom_px:g}"/>'
            + _text(x_px, bottom_px + 15, f"{value:g}", "middle")
        )
    return "".join(lines)


def _line(line: Series, at: int, x_axis: _Axis, y_axis: _Axis) -> str:
    """Draw one line; a point between two gaps becomes a dot."""
    path, dots, pen_down = [], [], False
    known = np.isfinite(line.x) & np.isfinite(line.y)
    for row in range(len(line.x)):
        if not known[row]:
            pen_down = False
            continue
        place = f"{x_axis.px(float(line.x[row])):.1f} {y_axis.px(float(line.y[row])):.1f}"
        path.append(f"{'L' if pen_down else 'M'}{place}")
        alone = not pen_down and not known[row + 1 : row + 2].any()
        if alone:
            x_px, y_px = place.split()
            dots.append(
                f'<circle class="c{at % NUM_COLOURS} dot" cx="{x_px}" cy="{y_px}" r="3"/>'
            )
        pen_down = True
    colour = f"c{at % NUM_COLOURS} d{at % NUM_COLOURS}"
    return f'<path class="line {colour}" d="{"".join(path)}"/>{"".join(dots)}'


def _interval(row: Interval, y_px: float, axis: _Axis) -> str:
    parts = [_text(_LABELS_PX - 10, y_px + 4, row.name, "end")]
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
    return f'<path class="line {look}" d="M{x_px:g} {y_px - 4:g}h24"/>' + _text(
        x_px + 30, y_px, name
    )


def _text(x_px: float, y_px: float, words: str, anchor: str = "start") -> str:
    return (
        f'<text class="ink" x="{x_px:.1f}" y="{y_px:.1f}" text-anchor="{anchor}">'
        f"{escape(words)}</text>"
    )


def _svg(width_px: float, height_px: float, title: str, parts: Sequence[str]) -> str:
    return (
        f'<svg class="figure" role="img" viewBox="0 0 {width_px:g} {height_px:g}" '
        f'width="{width_px:g}" xmlns="http://www.w3.org/2000/svg">'
        f"<title>{escape(title)}</title>"
        + f'<text class="title" x="{width_px / 2:g}" y="18" text-anchor="middle">'
        f"{escape(title)}</text>" + "".join(parts) + "</svg>"
    )
