"""Records to flat columns and back, by the shapes in their annotations.

A list of records of one type (a frozen dataclass, its arrays annotated by jaxtyping, other
such dataclasses nested in it) becomes a dictionary of one-dimensional arrays: every array
field laid end to end (``tracks.xyz_m``), and the sizes of every named dimension per record
(``dim.agent``). Nothing else is needed to cut the records out again, also from memory maps.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Generic, NamedTuple, TypeVar, get_type_hints

import numpy as np

T = TypeVar("T")
Columns = Mapping[str, np.ndarray]


class Column(NamedTuple):
    """One leaf of a record type.

    Attributes:
        path: Names of the fields that lead to it.
        dims: Dimensions of an array (``agent``, ``3``, ``feature+1``); None for a scalar.
        dtype: Of the stored values.
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
    """Lay records end to end. Inverse of ``Unpacked``.

    Raises:
        ValueError: if a dimension has two sizes within one record.
    """
    columns: dict[str, np.ndarray] = {}
    sizes: dict[str, np.ndarray] = {}
    for leaf in leaves(kind):
        values = [_value(record, leaf) for record in records]
        dims = leaf.dims if leaf.dims is not None else (f"len({leaf.name})",)
        if leaf.dims is not None or leaf.kind is str:
            _note_sizes(sizes, leaf.name, dims, values)
        flat = [value.reshape(-1) for value in values]
        columns[leaf.name] = np.concatenate([np.empty(0, leaf.dtype), *flat])
    return {**{f"dim.{dim}": size for dim, size in sizes.items()}, **columns}


class Unpacked(Generic[T], Sequence[T]):
    """Records cut out of columns on demand: ``records[3]`` touches only that record.

    Arrays are views of the columns; with memory maps nothing is read until it is used.
    """

    def __init__(self, columns: Columns, kind: type[T]) -> None:
        self._columns = columns
        self._kind = kind
        self._sizes = {k[4:]: v for k, v in columns.items() if k.startswith("dim.")}
        self._length = len(next(iter(self._sizes.values()))) if self._sizes else 0
        self._starts = {leaf.name: self._offsets(leaf) for leaf in leaves(self._kind)}

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        if not -len(self) <= row < len(self):
            raise IndexError(f"record {row} of {len(self)}")
        row = row % len(self)
        return self._build(self._kind, (), row)

    def __iter__(self) -> Iterator[T]:
        return (self[row] for row in range(len(self)))

    def column(self, name: str) -> np.ndarray:
        """Return one whole column, all records end to end."""
        return self._columns[name]

    def _offsets(self, leaf: Column) -> np.ndarray:
        if leaf.dims is None and leaf.kind is not str:
            return np.arange(self._length + 1)
        dims = leaf.dims if leaf.dims is not None else (f"len({leaf.name})",)
        sizes = np.ones(self._length, dtype=np.int64)
        for dim in dims:
            sizes = sizes * self._size(dim)
        return np.concatenate([[0], np.cumsum(sizes)])

    def _size(self, dim: str) -> np.ndarray:
        if dim.isdigit():
            return np.full(self._length, int(dim), dtype=np.int64)
        name, more = _split(dim)
        return self._sizes[name] + more

    def _build(self, kind: type, path: tuple[str, ...], row: int) -> Any:
        values: dict[str, Any] = {}
        inner: dict[str, type] = {
            f.name: get_hints(kind)[f.name]
            for f in fields(kind)
            if is_dataclass(get_hints(kind)[f.name])
        }
        for name, hint in inner.items():
            values[name] = self._build(hint, (*path, name), row)
        for leaf in leaves(kind):
            if len(leaf.path) == 1:
                values[leaf.path[0]] = self._cut(
                    leaf._replace(path=(*path, *leaf.path)), row
                )
        return kind(**values)

    def _cut(self, leaf: Column, row: int) -> Any:
        starts = self._starts[leaf.name]
        part = self._columns[leaf.name][starts[row] : starts[row + 1]]
        if leaf.kind is str:
            return part.tobytes().decode()
        if leaf.dims is None:
            return leaf.kind(part[0])
        return part.reshape([int(self._size(dim)[row]) for dim in leaf.dims])


@cache
def get_hints(kind: Any) -> dict[str, Any]:
    """Annotations of a record type, resolved once."""
    return get_type_hints(kind, include_extras=True)


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
        key, more = _split(dim)
        found = np.array([value.shape[axis] - more for value in values], dtype=np.int64)
        known = sizes.setdefault(key, found)
        if not np.array_equal(known, found):
            raise ValueError(f"{name}: dimension {key!r} has two sizes in one record")


def _split(dim: str) -> tuple[str, int]:
    match = re.fullmatch(r"(.+?)(?:\+(\d+))?", dim)
    if match is None:
        raise TypeError(f"cannot store dimension {dim!r}")
    return match[1], int(match[2] or 0)
