"""Tables on disk: indexes, and lists of refused records."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import polars as pl

Fields = Mapping[str, type]
"""Column names and types: ``str`` or ``int``."""


def make_table(rows: Sequence[Mapping[str, Any]], columns: Fields) -> "pl.DataFrame":
    """Make a table of rows with these columns, also without rows."""
    import polars as pl  # noqa: PLC0415

    of = {str: pl.String, int: pl.Int64, float: pl.Float64}
    types = {name: of[kind] for name, kind in columns.items()}
    return pl.DataFrame(list(rows), schema=types)


def read_tables(folders: Sequence[Path], name: str, columns: Fields) -> "pl.DataFrame":
    """Read and concatenate the tables of one name in several folders."""
    import polars as pl  # noqa: PLC0415

    tables = [pl.read_parquet(folder / name) for folder in folders]
    return pl.concat([make_table([], columns), *tables])
