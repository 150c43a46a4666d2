"""Tables of stage ``build-vocab``: the vocabularies, and how they fit each source."""

from collections.abc import Mapping
from typing import Any

from infgen.views.tables import Cell, Table


def figures_table(title: str, columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Lay figures out: one row each, one column per vocabulary."""
    names = next(iter(columns.values()))
    rows = [
        [name.replace("_", " "), *(_cell(column[name]) for column in columns.values())]
        for name in names
    ]
    return Table(title, ["", *columns], rows)


def sources_table(sources: Mapping[str, Mapping[str, Any]]) -> Table:
    """Lay out how far tokens are from the scenes of each source.

    Args:
        sources: By name, the figures of ``describe_source`` under ``tokens``, the number
            of ``scenes``, and whether they were ``held_out``.
    """
    rows: list[list[Cell]] = []
    for source, found in sources.items():
        seen = f"{found['scenes']} {'held out' if found['held_out'] else 'learned from'}"
        for token, error in found["tokens"].items():
            figures = error or {"count": 0, "mean": None, "p95": None}
            cells = [figures[name] for name in ("count", "mean", "p95")]
            rows.append([source, seen, token.replace("_", " "), *cells])
    return Table(
        "Token error by source",
        ["source", "scenes", "tokens of", "tokens", "mean, m", "95th percentile, m"],
        rows,
        note="Motion tokens: from the centre where the chain of tokens leads to the logged "
        "one, rolling forward. Map tokens: mean distance of middle and last point.",
    )


def _cell(figure: Any) -> Any:
    """A figure for a table; several become one line with their names."""
    if figure is None:
        return "nothing to measure"
    if isinstance(figure, Mapping):
        return ", ".join(f"{name} {value:g}" for name, value in figure.items())
    return figure
