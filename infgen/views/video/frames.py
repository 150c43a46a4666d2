"""Frames of a video: every showing in a pane, as in the player, and their counts below."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int64, UInt8

from infgen.clock import CLOCK
from infgen.views.scene.interpolation import ego_place
from infgen.views.scene.map_marks import map_marks
from infgen.views.scene.marks import View
from infgen.views.scene.view import moving_marks, scale_of
from infgen.views.scene.view_model import ViewModel
from infgen.views.video.layout import (
    Format,
    Pane,
    make_panes,
    paint_backdrop,
    paint_time,
)
from infgen.views.video.painter import Canvas, word_width

_VEIL = 0.5
"""How much of a showing that is over is covered."""


def num_frames(view_model: ViewModel, form: Format) -> int:
    """Frames from now to the end of the longest showing."""
    return round((view_model.num_steps - 1 - view_model.now) * CLOCK.step_s * form.fps)


def paint_frames(
    view_model: ViewModel, form: Format, first: int, count: int
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Paint some frames, in order.

    What does not change is painted once for all of them, so a few seconds at a time are
    quick to paint and small to hold. A frame is painted over by the next one.
    """
    times = [
        view_model.now + at / (form.fps * CLOCK.step_s)
        for at in range(first, first + count)
    ]
    panes = make_panes(view_model, form)
    backdrop = paint_backdrop(view_model, form, panes)
    painters = [_PanePainter(view_model, pane, times, form) for pane in panes]
    canvas = Canvas(backdrop.copy())
    for time in times:
        canvas.pixels[...] = backdrop
        for pane, painter in zip(panes, painters, strict=True):
            canvas.put(painter.paint(time), pane.left_px, pane.top_px)
        paint_time(canvas, view_model, form, time)
        yield canvas.pixels


class _PanePainter:
    """Paints one pane; the map under it is painted once for a stretch of time."""

    def __init__(
        self, view_model: ViewModel, pane: Pane, times: Sequence[float], form: Format
    ) -> None:
        self._film, self._pane, self._form = view_model, pane, form
        corners = np.array([self._corner_px(time) for time in times])
        self._left, self._top = int(corners[:, 0].min()), int(corners[:, 1].max())
        wide, high = np.ptp(corners, axis=0).tolist()
        width, height = wide + pane.width_px, high + pane.height_px
        whole = self._view(self._left, self._top, width, height)
        ground = Canvas.plain(width, height, form.colours.ground)
        ground.paint(map_marks(view_model.drawn_map, whole, form.colours))
        self._ground = ground.pixels
        self._canvas = Canvas.plain(pane.width_px, pane.height_px, form.colours.ground)

    def paint(self, time: float) -> UInt8[np.ndarray, "height width 3"]:
        """Paint a moment."""
        showing, theme, canvas = self._pane.showing, self._form.colours, self._canvas
        shown = min(time, showing.num_steps - 1.0)
        view = self._lay_ground(shown)
        canvas.paint(moving_marks(self._film, self._pane.agent_marks, shown, view, theme))
        if time > shown:
            self._cover()
        self._write(int(showing.valid[:, int(shown)].sum()))
        return canvas.pixels

    @property
    def _scale(self) -> float:
        return scale_of(float(self._pane.width_px), float(self._pane.height_px))

    def _corner_px(self, time: float) -> Int64[np.ndarray, "2"]:
        """Left and top edge of the window at a time, in whole pixels of the world, y up.

        Frames do not depend on which others are painted with them, and the map is cut out
        without being drawn again.
        """
        pane = self._pane
        middle = ego_place(pane.showing, time) * self._scale
        half = np.array([pane.width_px / 2, pane.height_px / 2])
        return np.rint(middle + half * (-1, 1)).astype(np.int64)

    def _view(self, left: int, top: int, width: int, height: int) -> View:
        """A window whose corner is on a whole pixel."""
        centre = (left + width / 2) / self._scale, (top - height / 2) / self._scale
        size = float(width), float(height)
        return View(centre, self._scale, *size, self._form.density)

    def _lay_ground(self, time: float) -> View:
        """Put the map down; returns the window."""
        width, height = self._pane.width_px, self._pane.height_px
        left, top = self._corner_px(time).tolist()
        x, y = left - self._left, self._top - top
        self._canvas.pixels[...] = self._ground[y : y + height, x : x + width]
        return self._view(left, top, width, height)

    def _cover(self) -> None:
        """Say that the showing is over, and let it stand back."""
        pane, theme, size = self._pane, self._form.colours, self._form.font_px
        veil = np.full((pane.height_px, pane.width_px), _VEIL, np.float32)
        self._canvas.blend(veil, 0, 0, theme.ground)
        place = (pane.width_px / 2, pane.height_px - size)
        words = f"the {pane.showing.name} ends here"
        self._canvas.write(words, place, size, theme.quiet, align=0.5)

    def _write(self, count: int) -> None:
        """Write the showing's name and how many are there."""
        canvas, theme, size = self._canvas, self._form.colours, self._form.font_px
        name, words = self._pane.showing.name.capitalize(), f"{count} agents"
        first, second = word_width(name, size), word_width(words, size)
        high = round(1.9 * size)
        canvas.box(0, 0, round(2.3 * size + first + second), high, theme.panel)
        canvas.box(0, 0, round(0.3 * size), high, self._pane.colour)
        canvas.write(name, (0.9 * size, 1.3 * size), size, theme.ink)
        canvas.write(words, (1.6 * size + first, 1.3 * size), size, theme.quiet)
