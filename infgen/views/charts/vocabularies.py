"""The vocabularies as charts: every token is drawn."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int8
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from infgen.scene import AgentType
from infgen.tokens.clustering.vocabularies import Origin
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from infgen.views.charts.canvas import COLOURS, Chart

_WIDTH_PX = 920.0
_MARGINS_PX = (40.0, 12.0, 34.0, 54.0)
_END_PX = 1.6
_LOOKS = {
    Origin.MADE: (COLOURS[1], "made by rule"),
    Origin.MIRRORED: (COLOURS[2], "mirror images of logs"),
    Origin.LOGGED: (COLOURS[0], "from logs"),
}
"""Colour and name of each origin, in the order of drawing."""


def vocabulary_charts(
    motion: MotionVocabulary,
    motion_origin: Int8[np.ndarray, "3 motion_token"],
    roads: MapVocabulary,
    road_origin: Int8[np.ndarray, " road"],
) -> tuple[Sequence[Chart], Chart]:
    """Draw the motion tokens of each agent type, and the map tokens.

    Args:
        motion: The motion tokens.
        motion_origin: ``Origin`` of each.
        roads: The map tokens.
        road_origin: ``Origin`` of each.
    """
    motions = [
        _curves_chart(
            f"{AgentType(kind).name.capitalize()}: motion tokens of half a second",
            motion.path[kind, ..., :2],
            motion_origin[kind],
        )
        for kind in range(len(motion.path))
    ]
    return motions, _curves_chart("Map tokens", roads.curve_m, road_origin)


def _curves_chart(
    title: str,
    curves_m: Float[np.ndarray, "curve point 2"],
    origin: Int8[np.ndarray, " curve"],
) -> Chart:
    """Draw curves, x to the right and y up, to scale, over a grid of one metre."""
    low, high = np.floor(curves_m.min(axis=(0, 1))), np.ceil(curves_m.max(axis=(0, 1)))
    high = np.maximum(high, low + 1.0)
    left, right, top, bottom = _MARGINS_PX
    px_per_m = (_WIDTH_PX - left - right) / float(high[0] - low[0])

    def draw(axes: Axes) -> None:
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="m")
        for kind, (colour, name) in _LOOKS.items():
            chosen = curves_m[origin == kind]
            if len(chosen):
                _draw_curves(axes, chosen, colour, name, _END_PX / px_per_m)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(5 if high[0] - low[0] > 10 else 1))
            axis.set_minor_locator(MultipleLocator(1))
        axes.grid(visible=True, which="minor", linewidth=0.4)
        axes.legend(loc="upper left", bbox_to_anchor=(0, -0.03), ncols=3, borderpad=0)

    height_px = top + bottom + px_per_m * float(high[1] - low[1])
    return Chart(title, draw, _WIDTH_PX, height_px, _MARGINS_PX)


def _draw_curves(
    axes: Axes,
    curves_m: Float[np.ndarray, "curve point 2"],
    colour: str,
    name: str,
    end_m: float,
) -> None:
    """Draw all curves as one line with gaps, and a dash at the end of each."""
    gap = np.full((len(curves_m), 1, 2), np.nan)
    ends = curves_m[:, -1:] + np.array([[-end_m / 2, 0.0], [end_m / 2, 0.0]])
    x, y = np.concatenate([curves_m, gap, ends, gap], axis=1).reshape(-1, 2).T
    axes.plot(x, y, color=colour, lw=0.7, alpha=0.55, label=name)
