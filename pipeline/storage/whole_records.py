"""Records as runs of bytes: one read each, whatever number of arrays they have.

Training reads scenes in any order. Column by column, each would be some fifty files to
open; here a group has two columns: ``bytes``, the records one after the other, and
``sizes``, their dimensions. What is where in a record follows from the latter.
"""

import math
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from pipeline.storage.columns import (
    Values,
    dims_of,
    layout_of,
    leaves,
    make,
    names,
    pack,
    split_dim,
)
from pipeline.storage.zarr_store import StoreError, open_group, write_group

T = TypeVar("T")

ALIGNED_BYTES = 8
"""Arrays begin at multiples of this."""
BYTES, SIZES = "bytes", "sizes"


class _Part(NamedTuple):
    """One leaf of a record type.

    Attributes:
        dtype: Of its values.
        dims: Its dimensions: a fixed size, or which of the record's sizes and what is
            added to it.
        kind: Python type of a scalar; None for an array.
    """

    dtype: np.dtype
    dims: tuple[int | tuple[int, int], ...]
    kind: type | None


class WholeRecords(Sequence[T], Generic[T]):
    """Records read on demand, each with one read; arrays are views of what was read.

    Args:
        data: All records, one after the other.
        sizes: Their dimensions [record, dimension].
        kind: Type of the records.
    """

    def __init__(self, data: Values, sizes: np.ndarray, kind: type[T]) -> None:
        record: Any = kind  # A type is hashable, whatever the type checker thinks.
        self._data, self._sizes, self._kind = data, sizes, record
        self._parts = _parts(record)
        self._layout = layout_of(record, count())
        lengths = sum(
            (_padded(_length(part, sizes)) for part in self._parts),
            start=np.zeros(len(sizes), np.int64),
        )
        self._starts = np.concatenate([[0], np.cumsum(lengths)])

    def __len__(self) -> int:
        return len(self._sizes)

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        if not -len(self) <= row < len(self):
            raise IndexError(f"record {row} of {len(self)}")
        row = row % len(self)
        sizes = self._sizes[row].tolist()
        data = self._data[int(self._starts[row]) : int(self._starts[row + 1])]
        values, at = [], 0
        for dtype, dims, kind in self._parts:
            shape = [x if isinstance(x, int) else sizes[x[0]] + x[1] for x in dims]
            length = math.prod(shape) * dtype.itemsize
            part = data[at : at + length].view(dtype)
            values.append(_value(part, kind) if kind else part.reshape(shape))
            at += _padded(length)
        return make(self._layout, values)

    @property
    def num_bytes(self) -> int:
        """Length of all records."""
        return int(self._starts[-1])

    def sizes(self, dim: str) -> np.ndarray:
        """Return the size of one named dimension in every record."""
        return self._sizes[:, dimensions(self._kind).index(dim)]


def dimensions(kind: Any) -> list[str]:
    """Names of the dimensions of a record type, in the order of their sizes."""
    return sorted(name[4:] for name in names(kind) if name.startswith("dim."))


def write_whole_records(path: Path, records: Sequence[Any], kind: Any, schema: str) -> None:
    """Write records as a new group; ``schema`` names their layout and version."""
    dims, chunks, sizes = dimensions(kind), [np.empty(0, np.uint8)], []
    for record in records:
        columns = pack([record], kind)
        sizes.append([int(columns[f"dim.{dim}"][0]) for dim in dims])
        for leaf in leaves(kind):
            data = np.frombuffer(columns[leaf.name].tobytes(), np.uint8)
            chunks.append(np.pad(data, (0, _padded(len(data)) - len(data))))
    table = np.array(sizes, np.int64).reshape(-1)
    columns = {BYTES: np.concatenate(chunks), SIZES: table}
    attributes = {"schema": schema, "count": len(records), "dims": dims}
    write_group(path, columns, attributes, compress=False)


def read_whole_records(path: Path, kind: type[T], schema: str) -> WholeRecords[T]:
    """Open a group of records; only their sizes are read.

    Raises:
        StoreError: if the group holds another schema, or is damaged.
    """
    columns, attributes = open_group(path)
    found = attributes.get("schema")
    if found != schema:
        raise StoreError(
            f"{path} holds {found!r}, expected {schema!r}; run its stage again"
        )
    lost = {BYTES, SIZES} - columns.keys()
    dims = dimensions(kind)
    if lost or attributes.get("dims") != dims:
        what = ", ".join(sorted(lost)) or f"dimensions {', '.join(dims)}"
        raise StoreError(f"{path} lacks {what}; `infgen verify` lists damage")
    sizes = columns[SIZES][:].reshape(-1, len(dims))
    records = WholeRecords(columns[BYTES], sizes, kind)
    if records.num_bytes != len(columns[BYTES]):
        raise StoreError(
            f"{path} holds {len(columns[BYTES])} bytes of records, expected "
            f"{records.num_bytes}; `infgen verify` lists damage"
        )
    return records


def _parts(kind: Any) -> list[_Part]:
    order = dimensions(kind)

    def size(dim: str) -> int | tuple[int, int]:
        name, more = split_dim(dim)
        return int(dim) if dim.isdigit() else (order.index(name), more)

    return [
        _Part(
            leaf.dtype,
            tuple(size(dim) for dim in dims_of(leaf)),
            leaf.kind if leaf.dims is None else None,
        )
        for leaf in leaves(kind)
    ]


def _length(part: _Part, sizes: np.ndarray) -> np.ndarray:
    """Bytes of one leaf in every record."""
    length = np.full(len(sizes), part.dtype.itemsize, np.int64)
    for dim in part.dims:
        length *= dim if isinstance(dim, int) else sizes[:, dim[0]] + dim[1]
    return length


def _padded(length: Any) -> Any:
    """Bytes up to where the next array begins."""
    return length + -length % ALIGNED_BYTES


def _value(part: np.ndarray, kind: type) -> Any:
    return part.tobytes().decode() if kind is str else kind(part[0])
