"""The vocabularies on one page: every token drawn, and statistics in tables.

The page is self-contained: no scripts, fonts or pictures from elsewhere.
"""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Int8

from infgen.scene import AgentType
from infgen.tokens.clustering.vocabularies import Origin
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary

_WIDTH_PX = 920
_MARGIN_PX = 24
_COLOUR = {Origin.LOGGED: "#1b6ca8", Origin.MIRRORED: "#3a9d5d", Origin.MADE: "#d08a2e"}
_WORDS = {
    Origin.LOGGED: "from logs",
    Origin.MIRRORED: "mirror images of logs",
    Origin.MADE: "made by rule",
}

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 960px;
       margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .2em .8em; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
svg { background: #fafafa; border: 1px solid #ddd; max-width: 100%; height: auto; }
.key { display: inline-block; width: 1.4em; border-top: 3px solid; vertical-align: middle;
       margin: 0 .4em 0 1.2em; }
"""


def vocabulary_page(
    report: Mapping[str, Any],
    motion: MotionVocabulary,
    move_origin: Int8[np.ndarray, "3 move"],
    roads: MapVocabulary,
    road_origin: Int8[np.ndarray, " road"],
) -> str:
    """Write the page (HTML) of a vocabulary report.

    Args:
        report: What stage ``build-vocab`` says of the vocabularies (its ``report.json``).
        motion: The moves.
        move_origin: ``Origin`` of each.
        roads: The shapes of map pieces.
        road_origin: ``Origin`` of each.
    """
    parts = [
        "<h1>Vocabularies</h1>",
        f"<p>Made from {report['scenes']['learn']} scenes; coverage measured on "
        f"{escape(report['validation_split'])}. Motion tokens are at least "
        f"{report['tolerance_m']} m apart "
        "(mean distance of box corners at their ends), unless a table says less.</p>",
        "<h2>Moves</h2>",
        _table(report["motion"]),
        _key(),
    ]
    for kind in range(len(motion.path)):
        title = f"{AgentType(kind).name.capitalize()}: paths of half a second"
        parts += [
            f"<h3>{title}</h3>",
            _picture(motion.path[kind, ..., :2], move_origin[kind]),
        ]
    parts += [
        "<h2>Map pieces</h2>",
        f"<p>Tolerance {report['road_tolerance_m']} m (mean distance of middle and last "
        "point).</p>",
        _table({"map piece": report["roads"]}),
        _picture(roads.curve_m, road_origin),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>Vocabularies</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _table(columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Lay figures out: one row each, one column per vocabulary."""
    names = list(next(iter(columns.values())))
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    rows = []
    for name in names:
        cells = "".join(f"<td>{_words(column[name])}</td>" for column in columns.values())
        rows.append(f"<tr><td>{escape(name.replace('_', ' '))}</td>{cells}</tr>")
    return f"<table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def _words(figure: Any) -> str:
    """Write a figure, or several with their names."""
    if figure is None:
        return "nothing to measure"
    if isinstance(figure, Mapping):
        return "<br>".join(f"{escape(name)} {value:g}" for name, value in figure.items())
    return escape(str(figure))


def _key() -> str:
    items = "".join(
        f'<span class="key" style="border-color:{_COLOUR[origin]}"></span>{_WORDS[origin]}'
        for origin in Origin
    )
    return f"<p>{items}</p>"


def _picture(curves_m: np.ndarray, origin: np.ndarray) -> str:
    """Draw curves [curve, point, 2], x to the right and y up, with a 1 m grid behind."""
    low, high = np.floor(curves_m.min(axis=(0, 1))), np.ceil(curves_m.max(axis=(0, 1)))
    scale = float((_WIDTH_PX - 2 * _MARGIN_PX) / (high[0] - low[0]))
    height = scale * (high[1] - low[1]) + 2 * _MARGIN_PX
    flipped = np.array([1, -1]) * scale
    corner = np.array([low[0], high[1]])
    points_px = (curves_m - corner) * flipped + _MARGIN_PX
    ends = [
        f'<path d="{_path(points_px[origin == kind])}" fill="none" stroke="{colour}" '
        'stroke-width="0.7" stroke-opacity="0.55"/>'
        for kind, colour in sorted(_COLOUR.items(), reverse=True)
        if (origin == kind).any()
    ]
    return (
        f'<svg viewBox="0 0 {_WIDTH_PX} {height:.0f}" width="{_WIDTH_PX}" '
        f'xmlns="http://www.w3.org/2000/svg">{_grid(low, high, scale)}{"".join(ends)}</svg>'
    )


def _path(points_px: np.ndarray) -> str:
    """Write polylines [line, point, 2] as one path, each with a dot at its end."""
    lines = []
    for line in np.round(points_px, 1):
        start, *rest = (f"{x:g} {y:g}" for x, y in line)
        lines.append(f"M{start}L{' '.join(rest)}m-.8 0h1.6")
    return "".join(lines)


def _grid(low: np.ndarray, high: np.ndarray, scale: float) -> str:
    """Draw lines every metre, and say how many metres every few."""
    every = 5 if high[0] - low[0] > 10 else 1
    bottom = scale * (high[1] - low[1]) + _MARGIN_PX
    right = scale * (high[0] - low[0]) + _MARGIN_PX
    lines, labels = [], []
    for x_m in np.arange(low[0], high[0] + 1):
        x_px = (x_m - low[0]) * scale + _MARGIN_PX
        lines.append(f"M{x_px:.1f} {_MARGIN_PX}V{bottom:.1f}")
        if x_m % every == 0:
            labels.append(f'<text x="{x_px:.1f}" y="{bottom + 16:.1f}">{x_m:g} m</text>')
    for y_m in np.arange(low[1], high[1] + 1):
        y_px = (high[1] - y_m) * scale + _MARGIN_PX
        lines.append(f"M{_MARGIN_PX} {y_px:.1f}H{right:.1f}")
    return (
        f'<path d="{"".join(lines)}" stroke="#e3e3e3" fill="none"/>'
        f'<g font-size="11" fill="#777" text-anchor="middle">{"".join(labels)}</g>'
    )
