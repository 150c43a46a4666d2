"""The frame of a page: one file, readable in light and dark, in print and on a phone."""

from collections.abc import Sequence
from html import escape

STYLE = (
    """
:root { --paper: #fff; --ink: #1c1c1c; --faint: #d8d8d8; --quiet: #606060; --road: #9a9a9a;
  --c0: #0072b2; --c1: #d55e00; --c2: #009e73; --c3: #b0568c; --c4: #a07800;
  --c5: #56a4d8; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #16181b; --ink: #e6e6e6; --faint: #3a3d42; --quiet: #a0a4aa;
    --road: #74787e; --c0: #4aa8e0; --c1: #f08a3c; --c2: #2fc79b; --c3: #dd8fbe;
    --c4: #d9b13b; --c5: #9fd2f2; } }
@media print { :root { --paper: #fff; --ink: #000; }
  figure, table { break-inside: avoid; } }
body { background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
  max-width: 1120px; margin: 2em auto; padding: 0 1em; }
h2 { margin-top: 2em; border-bottom: 1px solid var(--faint); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: .15em .7em; border-bottom: 1px solid var(--faint); text-align: right; }
th:first-child, td:first-child, td.text { text-align: left; }
.note { color: var(--quiet); max-width: 72ch; }
.figures { display: flex; flex-wrap: wrap; gap: 1em; }
figure { margin: 0; max-width: 100%; }
svg { max-width: 100%; height: auto; }
svg text { font: 12px system-ui, sans-serif; fill: var(--ink); }
svg text.title { font-weight: 600; font-size: 13px; }
svg .grid { stroke: var(--faint); fill: none; }
svg .line { fill: none; stroke-width: 1.8; }
svg .dot { stroke: none; }
svg .ring { fill: var(--paper); stroke-width: 1.8; }
"""
    + "".join(
        f"svg .c{at} {{ stroke: var(--c{at}); }} svg .c{at}.dot {{ fill: var(--c{at}); }}\n"
        for at in range(6)
    )
    + """
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
