"""The frame of a page: one file, readable in light and dark, in print and on a phone."""

import re
from collections.abc import Sequence
from html import escape

from infgen.views.charts.axes import NUM_COLOURS

_COLOURS = """
:root { --paper: #fff; --ink: #1c1c1c; --faint: #d8d8d8; --quiet: #606060; --road: #9a9a9a;
  --c0: #0072b2; --c1: #d55e00; --c2: #009e73; --c3: #b0568c; --c4: #a07800;
  --c5: #56a4d8; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #16181b; --ink: #e6e6e6; --faint: #3a3d42; --quiet: #a0a4aa;
    --road: #74787e; --c0: #4aa8e0; --c1: #f08a3c; --c2: #2fc79b; --c3: #dd8fbe;
    --c4: #d9b13b; --c5: #9fd2f2; } }
@media print { :root { --paper: #fff; --ink: #000; } }
"""
_PAGE = """
body { background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
  max-width: 1120px; margin: 2em auto; padding: 0 1em; }
h2 { margin-top: 2em; border-bottom: 1px solid var(--faint); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: .15em .7em; border-bottom: 1px solid var(--faint); text-align: right; }
th:first-child, td:first-child, td.text { text-align: left; }
.note { color: var(--quiet); max-width: 72ch; }
a { color: var(--c0); }
.figures { display: flex; flex-wrap: wrap; gap: 1em; }
figure { margin: 0; max-width: 100%; }
svg { max-width: 100%; height: auto; }
iframe { width: 100%; height: 40em; border: 1px solid var(--faint); }
@media print {
  @page { margin: 12mm; }
  body { max-width: none; margin: 0; padding: 0; font-size: 11px; }
  figure, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  .wide { overflow: visible; }
  table { font-size: 8.5px; }
  th, td { padding: .1em .4em; }
  th, td.text { overflow-wrap: anywhere; }
}
"""
_DRAWING = (
    """
svg text { font: 12px system-ui, sans-serif; fill: var(--ink); }
svg text.title { font-weight: 600; font-size: 13px; }
svg text.small { font-size: 10px; }
svg .grid { stroke: var(--faint); fill: none; }
svg .diagonal { stroke: var(--quiet); fill: none; stroke-dasharray: 4 3; }
svg .line { fill: none; stroke-width: 1.8; }
svg .inked { stroke: var(--ink); }
svg .dot { stroke: none; }
svg .ring { fill: var(--paper); stroke-width: 1.8; }
"""
    + "".join(
        f"svg .c{at} {{ stroke: var(--c{at}); }} svg .c{at}.dot {{ fill: var(--c{at}); }}\n"
        f"svg .c{at}.band, svg text.w{at} {{ fill: var(--c{at}); }}\n"
        for at in range(NUM_COLOURS)
    )
    + """
svg .band { fill-opacity: .16; stroke-opacity: .25; stroke-width: .6; }
svg .d1 { stroke-dasharray: 7 3; } svg .d2 { stroke-dasharray: 2 3; }
svg .d3 { stroke-dasharray: 9 3 2 3; } svg .d4 { stroke-dasharray: 12 4; }
svg .d5 { stroke-dasharray: 4 2 1 2; }
svg .view { fill: var(--paper); stroke: var(--faint); }
svg .lane { stroke: var(--faint); fill: none; stroke-width: 1.2; }
svg .edge { stroke: var(--road); fill: none; stroke-width: 1.4; }
svg .paint { stroke: var(--c4); fill: none; stroke-width: .7; stroke-dasharray: 3 2; }
svg .zebra { stroke: none; fill: var(--faint); fill-opacity: .6; }
svg .agent { stroke: var(--paper); stroke-width: .5; }
svg .ego { fill: var(--c1); }
svg .initial { fill: var(--c0); }
svg .inserted { fill: var(--c2); }
"""
)
STYLE = _COLOURS + _PAGE + _DRAWING
_GAP_PX, _HEAD_PX = 16.0, 34.0
_VIEW_BOX = re.compile(r'viewBox="0 0 (\S+) (\S+)"')


def page(title: str, parts: Sequence[str]) -> str:
    """Write a whole page; the parts are HTML already."""
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{STYLE}</style>"
    )
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n'
        f"<body>\n<h1>{escape(title)}</h1>\n{body}\n</body></html>\n"
    )


def heading(words: str) -> str:
    """Head a section."""
    return f"<h2>{escape(words)}</h2>"


def paragraph(words: str, *, note: bool = False) -> str:
    """Write a paragraph of plain words."""
    return f'<p class="note">{escape(words)}</p>' if note else f"<p>{escape(words)}</p>"


def figures(drawings: Sequence[str]) -> str:
    """Set SVG drawings side by side."""
    return (
        '<div class="figures">'
        + "".join(f"<figure>{d}</figure>" for d in drawings)
        + "</div>"
    )


def inset(path: str, words: str) -> str:
    """Show another page that lies beside this one, with words that name it."""
    place = escape(path, quote=True)
    return (
        f'<p class="note">{escape(words)} <a href="{place}">{place}</a></p>'
        f'<iframe title="{place}" src="{place}"></iframe>'
    )


def sheet(title: str, drawings: Sequence[str], columns: int = 3) -> str:
    """Set drawings in rows on one drawing that stands alone, colours and fonts included."""
    parts, y_px, width = [], _HEAD_PX, 0.0
    for first in range(0, len(drawings), columns):
        row, x_px, tallest = drawings[first : first + columns], 0.0, 0.0
        for drawing in row:
            wide, high = _size_px(drawing)
            parts.append(f'<g transform="translate({x_px:g} {y_px:g})">{drawing}</g>')
            x_px, tallest = x_px + wide + _GAP_PX, max(tallest, high)
        y_px, width = y_px + tallest + _GAP_PX, max(width, x_px - _GAP_PX)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {y_px:g}" '
        f'width="{width:g}" height="{y_px:g}"><title>{escape(title)}</title>'
        f"<style>{_COLOURS}{_DRAWING}.paper {{ fill: var(--paper); }}</style>"
        f'<rect class="paper" width="{width:g}" height="{y_px:g}"/>'
        f'<text class="title" x="{width / 2:g}" y="22" text-anchor="middle">'
        f"{escape(title)}</text>{''.join(parts)}</svg>\n"
    )


def _size_px(drawing: str) -> tuple[float, float]:
    """Width and height that a drawing says it has."""
    found = _VIEW_BOX.search(drawing)
    if found is None:
        raise ValueError("a drawing without viewBox has no size")
    return float(found[1]), float(found[2])
