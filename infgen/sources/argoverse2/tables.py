"""Parquet and Feather tables of Argoverse 2, read by polars."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from infgen.sources.tfrecord import RecordError

MAX_ROWS = 300_000
"""Rows of one table; the largest real one has about 60,000."""
FLOAT, INTEGER, TEXT = np.float64, np.int64, np.str_


def read_parquet(data: bytes, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Read columns of a Parquet table; see ``_read``."""
    import polars as pl  # noqa: PLC0415

    return _read(pl.read_parquet, data, columns, "Parquet")


def read_feather(data: bytes, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Read columns of a Feather (Arrow IPC) table; see ``_read``."""
    import polars as pl  # noqa: PLC0415

    return _read(pl.read_ipc, data, columns, "Feather")


def _read(
    read: Any, data: bytes, columns: Mapping[str, type], kind: str
) -> dict[str, np.ndarray]:
    """Read some columns of a table as arrays of the types asked for.

    Raises:
        RecordError: if it is no such table, a column is missing, of another type or has
            missing values, or if there are no rows or too many.
    """
    import polars as pl  # noqa: PLC0415

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


def _column(column: Any, kind: type) -> np.ndarray:
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
    if kind is TEXT:
        return np.array(column.to_list(), object)
    with np.errstate(over="ignore", invalid="ignore"):
        return column.to_numpy().astype(kind)


def _line(error: BaseException) -> str:
    """First line of a message, short."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
