"""Parquet and Feather tables of Argoverse 2, read by polars in a process of its own."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from infgen.sources.argoverse2.table_process import TABLES
from infgen.sources.tfrecord import RecordError

MAX_ROWS = 300_000
"""Rows of one table; the largest real one has about 60,000."""
FLOAT, INTEGER, TEXT = "float", "integer", "text"
PARQUET, FEATHER = "Parquet", "Feather"
_TYPES = {FLOAT: np.float64, INTEGER: np.int64}


def read_parquet(data: bytes, columns: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Read columns of a Parquet table; see ``read_table``."""
    return TABLES.read(PARQUET, data, columns)


def read_feather(data: bytes, columns: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Read columns of a Feather (Arrow IPC) table; see ``read_table``."""
    return TABLES.read(FEATHER, data, columns)


def read_table(kind: str, data: bytes, columns: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Read some columns of a table as arrays of the given types, in this process.

    Raises:
        RecordError: if it is no such table, a column is missing, of another type or has
            missing values, or if there are no rows or too many.
    """
    import polars as pl  # noqa: PLC0415

    read: Any = {PARQUET: pl.read_parquet, FEATHER: pl.read_ipc}[kind]
    try:
        table = read(io.BytesIO(data), columns=list(columns), n_rows=MAX_ROWS + 1)
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        raise RecordError(f"not a usable {kind} table: {_line(error)}") from error
    except BaseException as error:
        # Rust panics on some damaged tables; its exception is no ``Exception``.
        if type(error).__name__ != "PanicException":
            raise
        raise RecordError(f"not a usable {kind} table: {_line(error)}") from error
    if not 0 < len(table) <= MAX_ROWS:
        raise RecordError(f"{kind} table has {len(table)} rows; expected 1 to {MAX_ROWS}")
    return {name: _column(table[name], kind) for name, kind in columns.items()}


def _column(column: Any, kind: str) -> np.ndarray:
    dtype, name = column.dtype, column.name
    fits = {
        FLOAT: dtype.is_float() or dtype.is_integer(),
        INTEGER: dtype.is_integer(),
        TEXT: str(dtype) in ("String", "Categorical", "Enum"),
    }
    if not fits[kind]:
        raise RecordError(f"column {name} is of type {dtype}")
    if column.null_count():
        raise RecordError(f"column {name} has {column.null_count()} missing values")
    if kind == TEXT:
        return np.array(column.to_list(), object)
    with np.errstate(over="ignore", invalid="ignore"):
        return column.to_numpy().astype(_TYPES[kind])


def _line(error: BaseException) -> str:
    """First line of a message, short."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
