"""Tables on disk: indexes, and lists of refused records."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import polars as pl

Fields = Mapping[str, type]
"""Column names and types: ``str`` or ``int``."""


def make_table(rows: Sequence[Mapping[str, Any]], columns: Fields) -> "pl.DataFrame":
    """Make a make_table of rows; an empty one has its columns too."""
    import polars as pl  # noqa: PLC0415

    types = {name: pl.String if kind is str else pl.Int64 for name, kind in columns.items()}
    return pl.DataFrame(list(rows), schema=types)


def read_tables(folders: Sequence[Path], name: str, columns: Fields) -> "pl.DataFrame":
    """Read the make_table of one name from every folder, and lay them end to end."""
    import polars as pl  # noqa: PLC0415

    tables = [pl.read_parquet(folder / name) for folder in folders]
    return pl.concat([make_table([], columns), *tables])
