"""Tables of measured numbers: what was measured, and how sure it is.

For people a number stands with half of its interval, ``0.6521 ± 0.0040``; for programs its
interval has columns of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from infgen.views.tables import NOT_MEASURED, Cell, Table, words


@dataclass(frozen=True, slots=True)
class Measured:
    """A number, and where it may lie; None where that is not known.

    Attributes:
        mean: Best guess.
        low: Lower end of its 95 % interval.
        high: Upper end.
    """

    mean: float | None
    low: float | None = None
    high: float | None = None

    @property
    def words(self) -> str:
        """It as people read it."""
        if self.mean is None:
            return NOT_MEASURED
        if self.low is None or self.high is None:
            return words(self.mean)
        return f"{words(self.mean)} ± {words((self.high - self.low) / 2)}"

    def scaled(self, factor: float) -> "Measured":
        """Return it in another unit."""
        ends = self.mean, self.low, self.high
        return Measured(*[None if end is None else end * factor for end in ends])

    def to_json(self) -> dict[str, float | None]:
        """Everything, by name."""
        return {"mean": self.mean, "low": self.low, "high": self.high}


SheetCell = Cell | Measured


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table some of whose cells are measured; the first column names its rows.

    Attributes:
        name: Of its files.
        title: Above it.
        columns: Names of the columns.
        rows: Cells; None where there is nothing.
        note: Below it.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[SheetCell]]
    note: str = ""

    def for_people(self) -> Table:
        """Write numbers with their intervals as words."""
        rows = [[_shown(cell) for cell in row] for row in self.rows]
        return Table(self.title, self.columns, rows, self.note)

    def for_programs(self) -> Table:
        """Give each number a column, and its interval two more if it has one anywhere."""
        spread = [
            any(_ends(row[at]) != [None, None] for row in self.rows)
            for at in range(len(self.columns))
        ]
        columns: list[str] = []
        for name, ends in zip(self.columns, spread, strict=True):
            columns += [name, f"{name}, low", f"{name}, high"] if ends else [name]
        rows = []
        for row in self.rows:
            cells: list[Cell] = []
            for cell, ends in zip(row, spread, strict=True):
                mean = cell.mean if isinstance(cell, Measured) else cell
                cells += [mean, *_ends(cell)] if ends else [mean]
            rows.append(cells)
        return Table(self.title, columns, rows, self.note)


def _shown(cell: SheetCell) -> Cell:
    return cell.words if isinstance(cell, Measured) else cell


def _ends(cell: SheetCell) -> list[Cell]:
    return [cell.low, cell.high] if isinstance(cell, Measured) else [None, None]
