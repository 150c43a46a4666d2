"""Tables as Markdown, LaTeX, CSV and JSON. Everything is escaped."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

Cell = str | int | float | None

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first column names its rows.

    Attributes:
        title: Above it.
        columns: Names of the columns.
        rows: Cells; None where there is nothing.
        note: Below it.
        links: Page that the first cell of each row leads to; empty for none. On pages only.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""
    links: Sequence[str] = ()

    @property
    def name(self) -> str:
        """Name of its files, without a suffix."""
        return slug(self.title)

    def to_markdown(self) -> str:
        """Write it in Markdown, heading included."""
        rule = ["---", *["---:"] * (len(self.columns) - 1)]
        head = [markdown(name) for name in self.columns]
        rows = [[markdown(words(cell)) for cell in row] for row in self.rows]
        table = "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))
        note = f"\n{markdown(self.note)}\n" if self.note else ""
        return f"### {markdown(self.title)}\n\n{table}\n{note}"

    def to_latex(self) -> str:
        """Write it in LaTeX (needs ``booktabs``)."""
        lines = [" & ".join(_latex(words(cell)) for cell in row) for row in self.rows]
        head = " & ".join(_latex(name) for name in self.columns)
        caption = _latex(f"{self.title}. {self.note}" if self.note else self.title)
        return "\n".join(
            [
                r"\begin{table}",
                rf"\caption{{{caption}}}",
                rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
                rf"\toprule {head} \\ \midrule",
                *(rf"{line} \\" for line in lines),
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
                "",
            ]
        )

    def to_csv(self) -> str:
        """Write it as comma-separated values; no spreadsheet takes a cell for a formula."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([_csv(name) for name in self.columns])
        writer.writerows([[_csv(cell) for cell in row] for row in self.rows])
        return file.getvalue()

    def to_json(self) -> dict[str, Any]:
        """Give columns and rows, numbers as numbers."""
        rows = [[_rounded(cell) for cell in row] for row in self.rows]
        return {"columns": list(self.columns), "rows": rows}


def slug(title: str) -> str:
    """Name a file after a title: small letters, digits and hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def is_text(cell: Cell) -> bool:
    """Whether a cell holds words, not a figure (``0.5 ± 0.1``)."""
    return isinstance(cell, str) and any(sign.isalpha() for sign in cell)


NOT_MEASURED = "not measured"
"""What people read in place of a score that needs what the data set lacks."""


def words(cell: Cell) -> str:
    """Write a cell for people."""
    if cell is None:
        return "-"
    if isinstance(cell, float):
        return f"{cell:.4f}" if abs(cell) < 10 else f"{cell:.2f}"
    return str(cell)


def flatten(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Cell]]:
    """List nested figures as (dotted name, value), in their own order."""
    found: list[tuple[str, Cell]] = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            found += flatten(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            found.append((f"{prefix}{name}", ", ".join(words(each) for each in value)))
        else:
            found.append((f"{prefix}{name}", value))
    return found


def markdown(text: str) -> str:
    """Escape what Markdown, or the HTML within it, would take for markup."""
    plain = escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*_\[\]|])", r"\\\1", plain)


def _latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)


def _csv(cell: Cell) -> Cell:
    if isinstance(cell, str) and cell.startswith(_FORMULA):
        return f"'{cell}"
    return _rounded(cell)


def _rounded(cell: Cell) -> Cell:
    return round(cell, 6) if isinstance(cell, float) else cell
