"""How every chart looks, and how it becomes SVG for a page or PDF for a paper.

Charts are drawn by matplotlib's object interface: no global figure, no global style. The
same chart is written as the same bytes every time.
"""

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b0568c", "#a07800", "#56a4d8")
"""Colours that people with colour-blindness can tell apart, after Okabe and Ito."""
DASHES: tuple[Any, ...] = (
    "solid",
    (0, (4, 1.7)),
    (0, (1.1, 1.7)),
    (0, (5, 1.7, 1.1, 1.7)),
    (0, (6.7, 2.2)),
    (0, (2.2, 1.1, 0.6, 1.1)),
)
INK, QUIET, FAINT, PAPER = "#1c1c1c", "#606060", "#d8d8d8", "#ffffff"
_VARIABLES = {INK: "ink", QUIET: "quiet", FAINT: "faint", PAPER: "paper"} | {
    colour: f"c{at}" for at, colour in enumerate(COLOURS)
}
_STYLE: dict[Any, Any] = {
    "axes.autolimit_mode": "round_numbers",
    "axes.axisbelow": True,
    "axes.edgecolor": FAINT,
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 13,
    "axes.titleweight": "bold",
    "axes.titley": 1.0,
    "axes.titlecolor": INK,
    "axes.xmargin": 0,
    "axes.ymargin": 0,
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.8,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "infgen",
    "text.parse_math": False,
    "xtick.bottom": False,
    "xtick.labelcolor": INK,
    "ytick.left": False,
    "ytick.labelcolor": INK,
}
_PX_PER_INCH = 72.0
_GAP_PX, _HEAD_PX = 16.0, 34.0
_TAGS = re.compile(r"<[^>]+>")
_LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")
_COUNTED_IDS = re.compile(r' id="[A-Za-z0-9.]+_\d+"')


@dataclass(frozen=True)
class Chart:
    """A chart that is drawn when it is first asked for.

    Attributes:
        title: Above it; its page of a PDF is named after it.
        draw: Draws it onto axes.
        width_px: Its width, axis labels included.
        height_px: Its height, title and legend included.
        margins_px: Room to the left, to the right, above and below the axes.
    """

    title: str
    draw: Callable[[Axes], None]
    width_px: float
    height_px: float
    margins_px: tuple[float, float, float, float]

    def to_svg(self) -> str:
        """Draw it as SVG that an HTML page can hold."""
        return _write_svg(self.figure, self.title)

    def draw_at(self, figure: Figure, left_px: float, top_px: float) -> None:
        """Draw it with its upper left corner at a place of a figure."""
        left, right, top, bottom = self.margins_px
        width_px, height_px = (figure.get_size_inches() * _PX_PER_INCH).tolist()
        box_px = (self.width_px - left - right, self.height_px - top - bottom)
        axes = figure.add_axes(
            (
                (left_px + left) / width_px,
                1 - (top_px + self.height_px - bottom) / height_px,
                box_px[0] / width_px,
                box_px[1] / height_px,
            )
        )
        axes.set_title(self.title)
        self.draw(axes)

    @cached_property
    def figure(self) -> Figure:
        """The chart as a figure of its own; drawn once, whatever it is written as."""
        with rc_context(_STYLE):
            figure = _empty_figure(self.width_px, self.height_px)
            self.draw_at(figure, 0.0, 0.0)
        return figure


def set_logarithmic(axes: Axes, *, x: bool = False, y: bool = True) -> None:
    """Make the y axis logarithmic, and x if asked: 1, 2, 5, 10, as plain numbers."""
    if y:
        axes.set_yscale("log")
    if x:
        axes.set_xscale("log")
    for axis in [axes.yaxis] * y + [axes.xaxis] * x:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def write_pdf(charts: Iterable[Chart]) -> bytes:
    """Draw charts as one PDF, fonts included: each has a page of its own size."""
    file = io.BytesIO()
    with rc_context(_STYLE), PdfPages(file, metadata={"CreationDate": None}) as pages:
        for chart in charts:
            pages.savefig(chart.figure)
    return file.getvalue()


def write_sheet(title: str, charts: Sequence[Chart], columns: int = 3) -> str:
    """Draw charts as one SVG, row by row."""
    rows = [charts[start : start + columns] for start in range(0, len(charts), columns)]
    widths_px = [sum(c.width_px + _GAP_PX for c in row) - _GAP_PX for row in rows]
    heights_px = [max(c.height_px for c in row) + _GAP_PX for row in rows]
    with rc_context(_STYLE):
        figure = _empty_figure(max(widths_px, default=200.0), _HEAD_PX + sum(heights_px))
        figure.suptitle(title, fontsize=15, color=INK, va="top")
        top_px = _HEAD_PX
        for row, height_px in zip(rows, heights_px, strict=True):
            left_px = 0.0
            for chart in row:
                chart.draw_at(figure, left_px, top_px)
                left_px += chart.width_px + _GAP_PX
            top_px += height_px
    return _write_svg(figure, title)


def _empty_figure(width_px: float, height_px: float) -> Figure:
    return Figure((width_px / _PX_PER_INCH, height_px / _PX_PER_INCH), dpi=_PX_PER_INCH)


def _write_svg(figure: Figure, title: str) -> str:
    """Write SVG in pixels whose colours follow the page, and are those here without one."""
    file = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context(_STYLE):
        figure.savefig(file, format="svg", transparent=True, metadata=nothing)
    drawn = file.getvalue()
    drawn = drawn[drawn.index("<svg") :].replace('pt" height=', '" height=')
    drawn = drawn.replace('pt" viewBox', '" role="img" viewBox', 1)
    drawn = _TAGS.sub(lambda tag: _LONG_DECIMALS.sub(r"\1", tag[0]), drawn)
    drawn = _COUNTED_IDS.sub("", drawn)
    for colour, variable in _VARIABLES.items():
        drawn = drawn.replace(colour, f"var(--{variable}, {colour})")
    head, rest = drawn.split(">", 1)
    return f"{head}><title>{escape(title)}</title>{rest}"
