"""Where everything is in a video's picture, and all of it that never changes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from infgen.clock import CLOCK
from infgen.errors import ConfigError
from infgen.views.scene.agent_marks import AgentMarks
from infgen.views.scene.marks import Mark
from infgen.views.scene.shapes import shape_of
from infgen.views.scene.style import NUM_SERIES, THEMES, Theme
from infgen.views.scene.view_model import LOG, Showing, ViewModel
from infgen.views.video.painter import Canvas

_HEAD, _FOOT, _FONT = 0.052, 0.13, 0.019
"""Heights of the head, of the strip below and of words, as shares of the picture's."""
_LEGEND = (("ego", "ego"), ("initial", "there at the start"), ("inserted", "came in later"))


@dataclass(frozen=True, slots=True)
class Format:
    """What a video is like.

    Attributes:
        width_px: Of the picture.
        height_px: Of the picture.
        fps: Pictures per second.
        theme: ``light`` or ``dark``.
    """

    width_px: int = 1920
    height_px: int = 1080
    fps: int = 25
    theme: str = "light"

    def __post_init__(self) -> None:
        """Refuse what cannot be encoded.

        Raises:
            ConfigError: naming the value and what is expected.
        """
        for name in ("width_px", "height_px"):
            value = getattr(self, name)
            if value < 240 or value % 2:
                raise ConfigError(f"{name} is {value}; expected an even number from 240 on")
        if not 1 <= self.fps <= 60:
            raise ConfigError(f"fps is {self.fps}; expected 1 to 60")
        if self.theme not in THEMES:
            raise ConfigError(f"theme is {self.theme!r}; expected {' or '.join(THEMES)}")

    @property
    def colours(self) -> Theme:
        """Colours of the theme."""
        return THEMES[self.theme]

    @property
    def font_px(self) -> float:
        """Size of plain words."""
        return _FONT * self.height_px

    @property
    def density(self) -> float:
        """Lines are as thick as on a screen of 900 pixels' height."""
        return self.height_px / 900


@dataclass(frozen=True, slots=True)
class Pane:
    """One showing and its place in the picture.

    Attributes:
        showing: What is seen in it.
        agent_marks: Everyone of the showing.
        colour: Of its line in the chart.
        left_px: Left edge in the picture.
        top_px: Top edge.
        width_px: Of the pane.
        height_px: Of the pane.
    """

    showing: Showing
    agent_marks: AgentMarks
    colour: str
    left_px: int
    top_px: int
    width_px: int
    height_px: int


def make_panes(view_model: ViewModel, form: Format) -> list[Pane]:
    """Share the picture out among the showings, so that their shorter sides are longest."""
    head, foot = round(_HEAD * form.height_px), round(_FOOT * form.height_px)
    width, height = form.width_px, form.height_px - head - foot
    count = len(view_model.showings)
    columns = max(
        range(1, count + 1), key=lambda n: min(width / n, height / -(-count // n))
    )
    rows, gap = -(-count // columns), max(1, form.height_px // 540)
    lefts = np.linspace(0, width + gap, columns + 1).round().astype(int)
    tops = head + np.linspace(0, height + gap, rows + 1).round().astype(int)
    colours, panes = _series(view_model, form.colours), []
    for at, showing in enumerate(view_model.showings):
        row, column = divmod(at, columns)
        panes.append(
            Pane(
                showing,
                AgentMarks(showing),
                colours[at],
                left_px=int(lefts[column]),
                top_px=int(tops[row]),
                width_px=int(lefts[column + 1] - lefts[column]) - gap,
                height_px=int(tops[row + 1] - tops[row]) - gap,
            )
        )
    return panes


def _series(view_model: ViewModel, theme: Theme) -> list[str]:
    """Colour of each showing: the log's own, and one after the other for rollouts."""
    rank, found = 0, []
    for showing in view_model.showings:
        found.append(theme.log if showing.name == LOG else getattr(theme, f"s{rank}"))
        rank = (rank + (showing.name != LOG)) % NUM_SERIES
    return found


def paint_backdrop(
    view_model: ViewModel, form: Format, panes: list[Pane]
) -> UInt8[np.ndarray, "height width 3"]:
    """Paint what stays: head, legend and the counts' lines."""
    theme, size = form.colours, form.font_px
    canvas = Canvas.plain(form.width_px, form.height_px, theme.panel)
    head = round(_HEAD * form.height_px)
    foot = form.height_px - round(_FOOT * form.height_px)
    canvas.box(0, head, form.width_px, foot, theme.faint)
    base = head / 2 + 0.35 * size
    wide = canvas.write("InfGen", (size, base), 1.1 * size, theme.ink)
    canvas.write(view_model.scenario_id, (1.8 * size + wide, base), size, theme.quiet)
    right = form.width_px - size
    for name, words in reversed(_LEGEND):
        right -= (
            canvas.write(words, (right, base), size, theme.quiet, align=1.0) + 1.4 * size
        )
        body = 0.34 * size * shape_of(0, 4.6, 2.0).body * (1, -1)
        canvas.paint([Mark(body + (right, head / 2), getattr(theme, name))])  # noqa: RUF005
        right -= 1.9 * size
    canvas.paint(_count_marks(view_model, form, panes))
    most = _most(view_model)
    for count in (0, most):
        place = (_chart_left(form) - 0.5 * size, _chart_y(form, count, most) + 0.3 * size)
        canvas.write(f"{count}", place, 0.8 * size, theme.quiet, align=1.0)
    return canvas.pixels


def _count_marks(view_model: ViewModel, form: Format, panes: list[Pane]) -> Iterator[Mark]:
    """Lines of how many agents there are."""
    most = _most(view_model)
    for pane in panes:
        counts = pane.showing.valid.sum(axis=0)[view_model.now :]
        steps = view_model.now + np.arange(len(counts), dtype=np.float64)
        x = [_chart_x(view_model, form, step) for step in steps.tolist()]
        y = [_chart_y(form, int(count), most) for count in counts.tolist()]
        width = (3 if pane.showing.name == LOG else 2) * form.density
        yield Mark(np.column_stack([x, y]), None, pane.colour, width, closed=False)


def paint_time(canvas: Canvas, view_model: ViewModel, form: Format, time: float) -> None:
    """Paint the head of the time over the counts, and say it."""
    theme, size = form.colours, form.font_px
    x = _chart_x(view_model, form, time)
    foot = form.height_px - round(_FOOT * form.height_px)
    margin, half = round(0.4 * size), form.density
    left = round(x - half)
    right = max(left + 1, round(x + half))
    canvas.box(left, foot + margin, right, form.height_px - margin, theme.accent)
    seconds = (time - view_model.now) * CLOCK.step_s
    place = (_chart_left(form) - 2.2 * size, (foot + form.height_px) / 2 + 0.5 * size)
    canvas.write(f"{seconds:.1f} s", place, 1.5 * size, theme.ink, align=1.0)


def _most(view_model: ViewModel) -> int:
    return max(int(showing.valid.sum(axis=0).max()) for showing in view_model.showings)


def _chart_left(form: Format) -> float:
    return 8.5 * form.font_px


def _chart_x(view_model: ViewModel, form: Format, step: float) -> float:
    share = (step - view_model.now) / max(1, view_model.num_steps - 1 - view_model.now)
    left = _chart_left(form)
    return left + share * (form.width_px - left - form.font_px)


def _chart_y(form: Format, count: int, most: int) -> float:
    foot, size = form.height_px * (1 - _FOOT), form.font_px
    low, high = form.height_px - 0.8 * size, foot + 0.8 * size
    return low - count / max(1, most) * (low - high)
