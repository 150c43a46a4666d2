"""What charts are made of: scales, ticks, grids and words, as pieces of SVG.

Colours, ink and fonts come from classes that ``page`` gives their values, light and dark.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

NUM_COLOURS = 6
"""Colours that a page defines: classes ``c0`` and so on, dashes ``d0`` and so on."""
MOST_DECADES, MOST_POWERS = 3, 8
"""Over more decades than these a logarithmic axis names powers of ten only, and not all."""


@dataclass(frozen=True, slots=True)
class Axis:
    """A scale from values to pixels.

    Attributes:
        low: Value at its start.
        high: Value at its end.
        from_px: Place of its start.
        to_px: Place of its end.
        logarithmic: Equal ratios, not equal differences, are equally far apart.
    """

    low: float
    high: float
    from_px: float
    to_px: float
    logarithmic: bool = False

    def px(self, value: float) -> float:
        """Place a value; on a logarithmic scale what is below its start stands there."""
        if self.logarithmic:
            share = np.log(max(value, self.low) / self.low) / np.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.from_px + float(share) * (self.to_px - self.from_px)


def fit(
    values: Sequence[Float[np.ndarray, "..."]],
    from_px: float,
    to_px: float,
    *,
    logarithmic: bool = False,
    most: int = 6,
) -> tuple[Axis, list[float]]:
    """Make a scale that all known values lie on, from round number to round number.

    Args:
        values: What is to be placed; on a logarithmic scale only positive ones count.
        from_px: Place of the start.
        to_px: Place of the end.
        logarithmic: Which scale.
        most: About how many ticks.

    Returns:
        The scale and its ticks.
    """
    if logarithmic:
        low, high = limits([np.where(part > 0, part, np.nan) for part in values])
        low = low if low > 0 else high / 10  # A single value was spread around.
        marks = decade_ticks(low, high)
    else:
        low, high = limits(values)
        marks = ticks(low, high, most)
    ends = min(low, marks[0]), max(high, marks[-1])
    return Axis(*ends, from_px, to_px, logarithmic), marks


def limits(values: Sequence[Float[np.ndarray, "..."]]) -> tuple[float, float]:
    """Least and greatest known value, apart even where there is one only, or none."""
    known = np.concatenate([np.zeros(0), *[np.ravel(part) for part in values]])
    known = known[np.isfinite(known)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    if high - low < 1e-9 * max(1.0, abs(high)):
        pad = 0.5 * abs(high) or 0.5
        low, high = low - pad, high + pad
    return low, high


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Choose round numbers that span a range: steps of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / (most - 1)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(
        power * part for part in (1, 2, 5, 10) if power * part >= rough * (1 - 1e-9)
    )
    first, last = np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9)
    return [float(round(step * at, 10)) for at in np.arange(first, last + 1)]


def decade_ticks(low: float, high: float) -> list[float]:
    """Choose round numbers that span a positive range: 1, 2 and 5 of every power of ten.

    Over many powers of ten only those themselves, or some of them.
    """
    first, last = np.floor(np.log10(low) + 1e-9), np.ceil(np.log10(high) - 1e-9)
    parts = (1, 2, 5) if last - first <= MOST_DECADES else (1,)
    stride = max(1.0, np.ceil((last - first) / MOST_POWERS))
    powers = np.arange(first, last + stride, stride).tolist()
    marks = [float(f"{part}e{power:.0f}") for power in powers for part in parts]
    start = max([at for at, mark in enumerate(marks) if mark <= low * (1 + 1e-9)])
    end = min([at for at, mark in enumerate(marks) if mark >= high * (1 - 1e-9)])
    return marks[start : end + 1]


def _tick(value: float) -> str:
    """Write the number at a tick; small ones short, so that they stay beside their axis."""
    return f"{value:.0e}".replace("e-0", "e-") if 0 < abs(value) < 1e-3 else f"{value:g}"


def grid(
    x_axis: Axis, y_axis: Axis, x_marks: Sequence[float], y_marks: Sequence[float]
) -> str:
    """Draw a line and a number at every tick of both axes."""
    lines = [x_grid(x_axis, x_marks, y_axis.to_px, y_axis.from_px)]
    for value in y_marks:
        y_px = y_axis.px(value)
        lines.append(
            f'<path class="grid" d="M{x_axis.from_px:g} {y_px:.1f}H{x_axis.to_px:g}"/>'
            + text(x_axis.from_px - 6, y_px + 4, _tick(value), "end")
        )
    return "".join(lines)


def x_grid(axis: Axis, marks: Sequence[float], top_px: float, bottom_px: float) -> str:
    """Draw a line and a number at every tick of an axis."""
    lines = []
    for value in marks:
        x_px = axis.px(value)
        lines.append(
            f'<path class="grid" d="M{x_px:.1f} {top_px:g}V{bottom_px:g}"/>'
            + text(x_px, bottom_px + 15, _tick(value), "middle")
        )
    return "".join(lines)


def names(x_axis: Axis, y_axis: Axis, x_label: str, y_label: str) -> str:
    """Write what the axes are: below the one, along the other."""
    x_px = (x_axis.from_px + x_axis.to_px) / 2
    y_px = (y_axis.from_px + y_axis.to_px) / 2
    return text(x_px, y_axis.from_px + 32, x_label, "middle") + (
        f'<text class="ink" transform="translate(14 {y_px:g}) rotate(-90)" '
        f'text-anchor="middle">{escape(y_label)}</text>'
    )


def line_path(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    x_axis: Axis,
    y_axis: Axis,
) -> tuple[str, list[tuple[float, float]]]:
    """Write a line as path data; it breaks at unknown points.

    Returns:
        The path, and the places of points between two gaps, of which it shows nothing.
    """
    path, alone, pen_down = [], [], False
    known = np.isfinite(x) & np.isfinite(y)
    for row in range(len(x)):
        if not known[row]:
            pen_down = False
            continue
        place = x_axis.px(float(x[row])), y_axis.px(float(y[row]))
        path.append(f"{'L' if pen_down else 'M'}{place[0]:.1f} {place[1]:.1f}")
        if not pen_down and not known[row + 1 : row + 2].any():
            alone.append(place)
        pen_down = True
    return "".join(path), alone


def dot(x_px: float, y_px: float, at: int, radius_px: float = 3.0) -> str:
    """Draw a dot in one of the colours."""
    place = f'cx="{x_px:.1f}" cy="{y_px:.1f}" r="{radius_px:g}"'
    return f'<circle class="c{at % NUM_COLOURS} dot" {place}/>'


def text(x_px: float, y_px: float, words: str, anchor: str = "start") -> str:
    """Write words that start, end or have their middle at a place."""
    return (
        f'<text class="ink" x="{x_px:.1f}" y="{y_px:.1f}" text-anchor="{anchor}">'
        f"{escape(words)}</text>"
    )


def drawing(width_px: float, height_px: float, title: str, parts: Sequence[str]) -> str:
    """Put the pieces of a chart together below its title."""
    return (
        f'<svg class="figure" role="img" viewBox="0 0 {width_px:g} {height_px:g}" '
        f'width="{width_px:g}" height="{height_px:g}" xmlns="http://www.w3.org/2000/svg">'
        f"<title>{escape(title)}</title>"
        + f'<text class="title" x="{width_px / 2:g}" y="18" text-anchor="middle">'
        f"{escape(title)}</text>" + "".join(parts) + "</svg>"
    )
