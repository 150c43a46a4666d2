"""Records to flat columns and back, by the shapes in their annotations.

A list of records of one type (a frozen dataclass with jaxtyping arrays, and such
dataclasses nested in it) becomes a dictionary of one-dimensional arrays: the concatenated
values of every field (``tracks.xyz_m``), and the size of every named dimension per record
(``dim.agent``). Records are sliced out of these again, also from columns on disk.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from typing import (
    Any,
    Generic,
    NamedTuple,
    Protocol,
    TypeVar,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

T = TypeVar("T")


@runtime_checkable
class Values(Protocol):
    """One column: an array, or an object that returns slices of one."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice, /) -> np.ndarray: ...


Columns = Mapping[str, Values]


class Column(NamedTuple):
    """One leaf of a record type.

    Attributes:
        path: Names of the fields that lead to it.
        dims: Dimensions of an array (``agent``, ``3``, ``feature+1``); None for a scalar.
        dtype: Type of the stored values.
        kind: Python type of a scalar.
    """

    path: tuple[str, ...]
    dims: tuple[str, ...] | None
    dtype: np.dtype
    kind: type

    @property
    def name(self) -> str:
        """Name of the column."""
        return ".".join(self.path)


_SCALARS: dict[Any, np.dtype] = {
    bool: np.dtype("uint8"),
    int: np.dtype("int64"),
    float: np.dtype("float64"),
    str: np.dtype("uint8"),
}


@cache
def leaves(kind: Any) -> tuple[Column, ...]:
    """List the columns of a record type, in the order of its fields.

    Raises:
        TypeError: if a field is neither an annotated array, a scalar nor such a record.
    """
    found: list[Column] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if is_dataclass(hint):
            inner = leaves(hint)  # type: ignore[arg-type]
            found += [leaf._replace(path=(name, *leaf.path)) for leaf in inner]
        elif hint in _SCALARS:
            found.append(Column((name,), None, _SCALARS[hint], hint))
        elif hasattr(hint, "dim_str"):
            dims = tuple(hint.dim_str.split())
            found.append(Column((name,), dims, np.dtype(hint.dtypes[0]), np.ndarray))
        else:
            raise TypeError(f"{kind.__name__}.{name}: cannot store {hint!r} in columns")
    return tuple(found)


def pack(records: Sequence[Any], kind: type) -> dict[str, np.ndarray]:
    """Concatenate records to columns. Inverse of ``PackedRecords``.

    Raises:
        ValueError: if a dimension has two sizes within one record.
    """
    columns: dict[str, np.ndarray] = {}
    sizes: dict[str, np.ndarray] = {}
    for leaf in leaves(kind):
        values = [_value(record, leaf) for record in records]
        _note_sizes(sizes, leaf.name, dims_of(leaf), values)
        flat = [value.reshape(-1) for value in values]
        columns[leaf.name] = np.concatenate([np.empty(0, leaf.dtype), *flat])
    return {**{f"dim.{dim}": size for dim, size in sizes.items()}, **columns}


class _Offsets(NamedTuple):
    """Where each record's part of some columns starts, for all columns of like shape.

    Attributes:
        starts: First element [record+1], before fixed dimensions are multiplied in.
        sizes: Size of each named dimension per record.
    """

    starts: np.ndarray
    sizes: tuple[np.ndarray, ...]


class _Slice(NamedTuple):
    """How one leaf is cut out: its column, its offsets, and its fixed dimensions.

    Attributes:
        values: The column.
        offsets: Which of the all_offsets it follows.
        factor: Product of its fixed dimensions.
        shape: Its dimensions: a fixed size, or ``-1 - i`` for the offsets's i-th size.
        kind: Python type of a scalar; None for an array.
    """

    values: Values
    offsets: int
    factor: int
    shape: tuple[int, ...]
    kind: type | None


class Layout(NamedTuple):
    """A record type with its fields in order: a leaf's number, or a nested maker."""

    kind: Any
    parts: "tuple[int | Layout, ...]"


class PackedRecords(Generic[T], Sequence[T]):
    """Records sliced out of columns on demand: ``records[3]`` reads only that record.

    Arrays are slices of the columns: views in memory, or read from columns on disk. What
    depends on the type alone is computed once: training reads one record at a time.
    """

    def __init__(self, columns: Columns, kind: type[T]) -> None:
        record: Any = (
            kind  # a type is hashable, whatever the type checker thinks of type[T]
        )
        self._columns = columns
        self._offsets: list[_Offsets] = []
        found: dict[tuple[str, ...], int] = {}
        self._slices = [self._slice(leaf, found) for leaf in leaves(record)]
        self._length = len(self._offsets[0].starts) - 1 if self._offsets else 0
        self._layout = layout_of(record, iter(range(len(self._slices))))

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        if not -self._length <= row < self._length:
            raise IndexError(f"record {row} of {self._length}")
        row = row % self._length
        all_offsets = [
            (int(starts[row]), int(starts[row + 1]), [int(size[row]) for size in sizes])
            for starts, sizes in self._offsets
        ]
        return make(self._layout, [_value_at(cut, all_offsets) for cut in self._slices])

    def __iter__(self) -> Iterator[T]:
        return (self[row] for row in range(len(self)))

    def column(self, name: str) -> np.ndarray:
        """Return one whole column of all records."""
        return self._columns[name][:]

    def sizes(self, dim: str) -> np.ndarray:
        """Return the size of one named dimension in every record."""
        return self._columns[f"dim.{dim}"][:]

    def _slice(self, leaf: Column, found: dict[tuple[str, ...], int]) -> _Slice:
        values = self._columns[leaf.name]
        dims = dims_of(leaf)
        named = tuple(dim for dim in dims if not dim.isdigit())
        factor = math.prod(int(dim) for dim in dims if dim.isdigit())
        if named not in found:
            found[named] = len(self._offsets)
            self._offsets.append(self._offsets_of(named, len(values) // factor))
        order = iter(range(len(named)))
        shape = tuple(int(dim) if dim.isdigit() else -1 - next(order) for dim in dims)
        scalar = leaf.kind if leaf.dims is None else None
        return _Slice(values, found[named], factor, shape, scalar)

    def _offsets_of(self, named: tuple[str, ...], length: int) -> _Offsets:
        if not named:
            return _Offsets(np.arange(length + 1), ())
        sizes = tuple(self._size(dim) for dim in named)
        per_record = np.prod(sizes, axis=0, dtype=np.int64)
        return _Offsets(np.concatenate([[0], np.cumsum(per_record)]), sizes)

    def _size(self, dim: str) -> np.ndarray:
        name, more = split_dim(dim)
        return self._columns[f"dim.{name}"][:] + more


def names(kind: Any) -> frozenset[str]:
    """Names of all columns that records of a type have, sizes included."""
    named = {
        f"dim.{split_dim(dim)[0]}"
        for leaf in leaves(kind)
        for dim in dims_of(leaf)
        if not dim.isdigit()
    }
    return frozenset(named | {leaf.name for leaf in leaves(kind)})


def layout_of(kind: Any, numbers: Iterator[int]) -> Layout:
    """Lay a record type out: which of its leaves' values makes which field."""
    hints = get_type_hints(kind, include_extras=True)
    return Layout(
        kind,
        tuple(
            layout_of(hint, numbers) if is_dataclass(hint) else next(numbers)
            for hint in hints.values()
        ),
    )


def make(maker: Layout, values: list[Any]) -> Any:
    """Make a record of the values of its leaves, in their order."""
    return maker.kind(
        *[
            values[part] if isinstance(part, int) else make(part, values)
            for part in maker.parts
        ]
    )


def _value_at(cut: _Slice, all_offsets: list[tuple[int, int, list[int]]]) -> Any:
    values, offsets, factor, shape, kind = cut
    start, stop, sizes = all_offsets[offsets]
    part = values[start * factor : stop * factor]
    if kind is str:
        return part.tobytes().decode()
    if kind is not None:
        return kind(part[0])
    if len(shape) == 1:
        return part
    return part.reshape([size if size >= 0 else sizes[-1 - size] for size in shape])


def dims_of(leaf: Column) -> tuple[str, ...]:
    """Dimensions of a leaf's array; a text has one of its own."""
    if leaf.dims is not None:
        return leaf.dims
    return (f"len({leaf.name})",) if leaf.kind is str else ()


def _value(record: Any, leaf: Column) -> np.ndarray:
    for name in leaf.path:
        record = getattr(record, name)
    if leaf.kind is str:
        return np.frombuffer(record.encode(), dtype=np.uint8)
    return np.asarray(record, dtype=leaf.dtype)


def _note_sizes(
    sizes: dict[str, np.ndarray], name: str, dims: tuple[str, ...], values: list[np.ndarray]
) -> None:
    for axis, dim in enumerate(dims):
        if dim.isdigit():
            continue
        key, more = split_dim(dim)
        found = np.array([value.shape[axis] - more for value in values], dtype=np.int64)
        known = sizes.setdefault(key, found)
        if not np.array_equal(known, found):
            raise ValueError(f"{name}: dimension {key!r} has two sizes in one record")


def split_dim(dim: str) -> tuple[str, int]:
    """Split a dimension such as ``feature+1`` into its name and what is added.

    Raises:
        TypeError: if it is none.
    """
    match = re.fullmatch(r"(.+?)(?:\+(\d+))?", dim)
    if match is None:
        raise TypeError(f"cannot store dimension {dim!r}")
    return match[1], int(match[2] or 0)
