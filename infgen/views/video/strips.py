"""Figure strips: every showing in a row, the same moments below each other.

As in the paper's qualitative figure, each picture is centred on where the ego is then. A
strip is an SVG drawing that stands alone; ``painter`` paints the same marks for a PNG.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from infgen.clock import CLOCK
from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.marks import Mark
from infgen.views.scene.shapes import shape_of
from infgen.views.scene.style import Theme
from infgen.views.scene.view import all_marks, view_of
from infgen.views.scene.view_model import Showing, ViewModel
from infgen.views.video.painter import Canvas

EVERY_S = 6.0
PICTURE_PX = 260
_GAP_PX, _TOP_PX, _LEFT_PX, _LEGEND_PX = 8, 26, 30, 34
FONT_PX = 14
_LEGEND = (
    ("ego", "ego", 0),
    ("initial", "there at the start", 84),
    ("inserted", "came in later", 252),
)
"""Colour, words and place of each sign below."""


class Picture(NamedTuple):
    """One picture of a strip.

    Attributes:
        x_px: Left edge in the strip.
        y_px: Top edge.
        marks: What is in it, relative to its corner; none where the showing is over.
    """

    x_px: float
    y_px: float
    marks: Sequence[Mark] | None


class Words(NamedTuple):
    """Words of a strip.

    Attributes:
        x_px: Their middle, or where they start.
        y_px: Of their base line.
        text: What they say.
        middle: Whether ``x_px`` is their middle.
        upright: Whether they run upwards.
    """

    x_px: float
    y_px: float
    text: str
    middle: bool = True
    upright: bool = False


@dataclass(frozen=True, slots=True)
class Strip:
    """A strip, ready to be written or painted.

    Attributes:
        title: Of the whole.
        width_px: Of the whole.
        height_px: Of the whole.
        pictures: Row by row.
        words: Around them.
        legend: Signs among the words.
        scale: What everything is enlarged by.
    """

    title: str
    width_px: float
    height_px: float
    pictures: Sequence[Picture]
    words: Sequence[Words]
    legend: Sequence[Mark]
    scale: float


def strip_times(view_model: ViewModel, every_s: float = EVERY_S) -> list[float]:
    """Seconds from now on, as far as the longest showing goes."""
    end_s = (view_model.num_steps - 1 - view_model.now) * CLOCK.step_s
    return [float(t) for t in np.arange(0.0, end_s + 1e-6, every_s)]


def make_strip(
    view_model: ViewModel, times_s: Sequence[float], theme: Theme, scale: float = 1.0
) -> Strip:
    """Lay out a strip.

    Args:
        view_model: What is shown.
        times_s: Seconds from now, one column each.
        theme: The colours.
        scale: Enlarges everything.

    Raises:
        ValueError: if a time is before the history or after the end.
    """
    end_s = (view_model.num_steps - 1 - view_model.now) * CLOCK.step_s
    for time_s in times_s:
        if not -view_model.now * CLOCK.step_s <= time_s <= end_s + 1e-6:
            raise ValueError(f"{time_s:g} s is not shown; the film ends at {end_s:g} s")
    pictures = [
        picture
        for row, showing in enumerate(view_model.showings)
        for picture in _row(view_model, showing, row, times_s, theme, scale)
    ]
    step = PICTURE_PX + _GAP_PX
    height = float(_TOP_PX + len(view_model.showings) * step + _LEGEND_PX - _GAP_PX)
    return Strip(
        title=f"Scene {view_model.scenario_id}",
        width_px=scale * (_LEFT_PX + len(times_s) * step - _GAP_PX),
        height_px=scale * height,
        pictures=pictures,
        words=list(_words(view_model, times_s, scale, height)),
        legend=list(_signs(theme, scale, height)),
        scale=scale,
    )


def strip_svg(strip: Strip, theme: Theme) -> str:
    """Write a strip as a drawing that stands alone."""
    pictures = [_picture_svg(picture, strip, theme) for picture in strip.pictures]
    words = [_words_svg(words, theme) for words in strip.words]
    size = f"{strip.width_px:g} {strip.height_px:g}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" role="img" '
        f'width="{strip.width_px:g}" height="{strip.height_px:g}" '
        f'font-family="system-ui, sans-serif" font-size="{FONT_PX * strip.scale:g}">'
        f"<title>{escape(strip.title)}</title>"
        f'<rect width="100%" height="100%" fill="{theme.panel}"/>'
        f"{''.join(pictures)}{''.join(words)}{marks_svg(strip.legend)}</svg>\n"
    )


def strip_picture(strip: Strip, theme: Theme) -> UInt8[np.ndarray, "height width 3"]:
    """Paint a strip.

    Raises:
        MissingExtraError: if the packages that paint are not installed.
    """
    size = round(strip.width_px), round(strip.height_px)
    canvas, side = Canvas.plain(*size, theme.panel), round(strip.scale * PICTURE_PX)
    canvas.paint(strip.legend)
    for picture in strip.pictures:
        if picture.marks is not None:
            own = Canvas.plain(side, side, theme.ground)
            own.paint(picture.marks)
            canvas.put(own.pixels, round(picture.x_px), round(picture.y_px))
    font_px = strip.scale * FONT_PX
    for words in strip.words:
        place, align = (words.x_px, words.y_px), 0.5 if words.middle else 0.0
        canvas.write(
            words.text, place, font_px, theme.ink, align=align, upright=words.upright
        )
    return canvas.pixels


def marks_svg(marks: Sequence[Mark]) -> str:
    """Write marks as paths."""
    return "".join(_mark_svg(mark) for mark in marks)


def _row(
    view_model: ViewModel,
    showing: Showing,
    row: int,
    times_s: Sequence[float],
    theme: Theme,
    scale: float,
) -> Iterator[Picture]:
    agent_marks, side = AgentMarks(showing), scale * PICTURE_PX
    for column, time_s in enumerate(times_s):
        time = view_model.now + time_s / CLOCK.step_s
        marks = None
        if time <= showing.num_steps - 1 + 1e-6:
            view = view_of(showing, time, side, side, scale)
            marks = list(all_marks(view_model, agent_marks, time, view, theme))
        x_px = _LEFT_PX + column * (PICTURE_PX + _GAP_PX)
        y_px = _TOP_PX + row * (PICTURE_PX + _GAP_PX)
        yield Picture(scale * x_px, scale * y_px, marks)


def _words(
    view_model: ViewModel, times_s: Sequence[float], scale: float, height: float
) -> Iterator[Words]:
    step, half = PICTURE_PX + _GAP_PX, PICTURE_PX / 2
    for column, time_s in enumerate(times_s):
        x_px = _LEFT_PX + column * step + half
        yield Words(scale * x_px, scale * 17, f"t = {time_s:g} s")
    for row, showing in enumerate(view_model.showings):
        y_px = _TOP_PX + row * step + half
        yield Words(scale * 19, scale * y_px, showing.name, upright=True)
        for column, time_s in enumerate(times_s):
            if view_model.now + time_s / CLOCK.step_s > showing.num_steps - 1 + 1e-6:
                x_px = _LEFT_PX + column * step + half
                yield Words(scale * x_px, scale * y_px, f"the {showing.name} has ended")
    for _, text, x_px in _LEGEND:
        place = scale * (_LEFT_PX + 32 + x_px), scale * (height - 10)
        yield Words(*place, text, middle=False)


def _signs(theme: Theme, scale: float, height: float) -> Iterator[Mark]:
    body = scale * 4.6 * (shape_of(0, 4.6, 2.0).body * (1, -1))
    for name, _, x_px in _LEGEND:
        middle = scale * np.array([_LEFT_PX + 14 + x_px, height - 15])
        yield Mark(body + middle, getattr(theme, name), None)


def _picture_svg(picture: Picture, strip: Strip, theme: Theme) -> str:
    side = f"{strip.scale * PICTURE_PX:g}"
    marks = marks_svg(picture.marks) if picture.marks is not None else ""
    colour = theme.ground if picture.marks is not None else theme.panel
    return (
        f'<svg x="{picture.x_px:g}" y="{picture.y_px:g}" width="{side}" height="{side}">'
        f'<rect width="100%" height="100%" fill="{colour}" stroke="{theme.faint}"/>'
        f"{marks}</svg>"
    )


def _mark_svg(mark: Mark) -> str:
    points = "L".join(f"{x:.1f} {y:.1f}" for x, y in mark.points_px.tolist())
    line = ""
    if mark.line:
        line = f' stroke="{mark.line}" stroke-width="{mark.width_px:.2g}"'
        line += ' stroke-linejoin="round"'
    alpha = f' opacity="{mark.alpha:.2g}"' if mark.alpha < 1 else ""
    end = "Z" if mark.closed else ""
    return f'<path d="M{points}{end}" fill="{mark.fill or "none"}"{line}{alpha}/>'


def _words_svg(words: Words, theme: Theme) -> str:
    place = f'x="{words.x_px:g}" y="{words.y_px:g}"'
    if words.upright:
        place += f' transform="rotate(-90 {words.x_px:g} {words.y_px:g})"'
    anchor = ' text-anchor="middle"' if words.middle else ""
    return f'<text {place}{anchor} fill="{theme.ink}">{escape(words.text)}</text>'
