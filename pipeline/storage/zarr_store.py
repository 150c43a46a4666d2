"""Columns in Zarr groups, each group one file, read whole or in parts.

Every array is one chunk. Without ``compress`` its only codec is crc32c: the chunk is the
array followed by four bytes, and any part of it can be read alone. A missing chunk is an
error, never zeros. Zarr is imported in functions: it takes a second, and neither ``infgen
status`` nor reading in parts needs it.
"""

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import google_crc32c
import numpy as np

from pipeline.engine.atomic import StoreError, publish, write_file, write_json
from pipeline.storage.columns import Columns, PackedRecords, names, pack
from pipeline.storage.group_file import StoredKey, open_group_file, write_group_file

__all__ = [
    "DiskColumn",
    "StoreError",
    "open_group",
    "publish",
    "read_group",
    "read_records",
    "write_file",
    "write_group",
    "write_json",
    "write_records",
]

T = TypeVar("T")

CHECKSUM_BYTES = 4


METADATA = "zarr.json"


class DiskColumn:
    """A column on disk, of which any part can be read; no file is kept open."""

    __slots__ = ("_chunk", "_length", "dtype")

    def __init__(self, chunk: StoredKey, dtype: np.dtype, length: int) -> None:
        self._chunk, self._length, self.dtype = chunk, length, dtype

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> np.ndarray:
        """Read a part.

        Raises:
            StoreError: if it is missing or cut short.
        """
        start, stop, _ = part.indices(self._length)
        if stop <= start:
            return np.empty(0, self.dtype)
        size, chunk = self.dtype.itemsize, self._chunk
        data = chunk.read(start * size, (stop - start) * size)
        return np.frombuffer(data, self.dtype)


def write_group(
    path: Path,
    columns: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
    *,
    compress: bool,
) -> None:
    """Write one-dimensional columns as a new Zarr v3 group.

    Zarr builds the group in memory, and its keys are then written directly: Zarr's own
    stores start a thread per access, which doubles the time.

    Raises:
        FileExistsError: if the path exists.
    """
    import zarr  # noqa: PLC0415
    from zarr.codecs import BloscCodec, Crc32cCodec  # noqa: PLC0415
    from zarr.storage import MemoryStore  # noqa: PLC0415

    # Level 5 takes five times as long and makes scenes smaller by a twelfth.
    packed = BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle")
    codecs = [packed, Crc32cCodec()] if compress else [Crc32cCodec()]
    files: dict[str, Any] = {}
    group = zarr.open_group(
        MemoryStore(files), mode="w-", zarr_format=3, attributes=dict(attributes)
    )
    for name, values in columns.items():
        array = group.create_array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            chunks=(max(1, len(values)),),
            compressors=codecs,
            filters=None,
            config={"write_empty_chunks": True},
        )
        if len(values):
            array[:] = values
    path.parent.mkdir(parents=True, exist_ok=True)
    write_group_file(path, {key: data.to_bytes() for key, data in sorted(files.items())})


def read_group(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all columns and the attributes of a group, checksums verified.

    Raises:
        StoreError: if a chunk is missing, cut short or damaged.
    """
    keys = open_group_file(path)
    about = _json(path, keys, METADATA)
    metadata = _metadata(path, keys)
    if all(_is_plain(meta) for meta in metadata.values()):
        columns = {
            name: _checked(path, keys.get(_chunk(name)), name, meta)
            for name, meta in metadata.items()
        }
        return columns, about.get("attributes", {})
    return _read_with_zarr(path, keys)


def _read_with_zarr(
    path: Path, keys: Mapping[str, StoredKey]
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a group that is compressed."""
    import zarr  # noqa: PLC0415

    columns = {}
    with _as_zarr_reads(path) as store:
        try:
            group = zarr.open_group(store, mode="r")
            arrays = sorted(group.arrays())
        except (ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise StoreError(f"{path} is damaged: {error}") from error
        for name, array in arrays:
            if array.size and _chunk(name) not in keys:
                raise StoreError(
                    f"{path} lacks {_chunk(name)}; `infgen verify` lists damage"
                )
            try:
                columns[name] = np.asarray(array[:])
            except (ValueError, RuntimeError, OSError, zipfile.BadZipFile) as error:
                raise StoreError(f"{path}: {_chunk(name)} is damaged: {error}") from error
    return columns, dict(group.attrs)


@contextmanager
def _as_zarr_reads(path: Path) -> Iterator[Any]:
    """Open what Zarr reads a group from: a zip archive, or a folder of before."""
    from zarr.storage import LocalStore, ZipStore  # noqa: PLC0415

    store = (LocalStore if path.is_dir() else ZipStore)(path, read_only=True)
    try:
        yield store
    finally:
        store.close()


def open_group(path: Path) -> tuple[dict[str, DiskColumn], dict[str, Any]]:
    """Open the columns of an uncompressed group without reading them.

    Raises:
        StoreError: if the group is compressed, or a chunk is missing or cut short.
    """
    keys = open_group_file(path)
    about = _json(path, keys, METADATA)
    columns = {}
    for name, meta in _metadata(path, keys).items():
        if not _is_plain(meta):
            raise StoreError(f"{path}: {name} is compressed and cannot be read in parts")
        columns[name] = _disk_column(path, keys.get(_chunk(name)), name, meta)
    return columns, about.get("attributes", {})


def _metadata(path: Path, keys: Mapping[str, StoredKey]) -> dict[str, dict[str, Any]]:
    """Read what a group says of its arrays, by name."""
    ending = f"/{METADATA}"
    names = sorted(key.removesuffix(ending) for key in keys if key.endswith(ending))
    return {name: _json(path, keys, f"{name}{ending}") for name in names}


def _is_plain(meta: Mapping[str, Any]) -> bool:
    """Whether a chunk is the bytes of its array and their checksum."""
    return [codec["name"] for codec in meta["codecs"]] == ["bytes", "crc32c"]


def write_records(
    path: Path, records: Sequence[Any], kind: type, schema: str, *, compress: bool
) -> None:
    """Write records of one type as a group; ``schema`` names their layout and version."""
    attributes = {"schema": schema, "count": len(records)}
    write_group(path, pack(records, kind), attributes, compress=compress)


def read_records(
    path: Path, kind: type[T], schema: str, *, whole: bool
) -> PackedRecords[T]:
    """Open a group of records: with ``whole`` read and verified at once, else on demand.

    Raises:
        StoreError: if the group holds another schema, or is damaged.
    """
    columns: Columns
    columns, attributes = read_group(path) if whole else open_group(path)
    if attributes.get("schema") != schema:
        found = attributes.get("schema")
        raise StoreError(
            f"{path} holds {found!r}, expected {schema!r}; run its stage again"
        )
    lost = sorted(names(kind) - columns.keys())
    if lost:
        raise StoreError(f"{path} lacks {', '.join(lost)}; `infgen verify` lists damage")
    return PackedRecords(columns, kind)


def _disk_column(
    path: Path, chunk: StoredKey | None, name: str, meta: Mapping[str, Any]
) -> DiskColumn:
    dtype, length = np.dtype(meta["data_type"]), int(meta["shape"][0])
    expected = length * dtype.itemsize + CHECKSUM_BYTES
    found = None if chunk is None else chunk.length
    if chunk is None or (length and found != expected):
        if not length:
            return DiskColumn(StoredKey(path, 0, 0), dtype, 0)
        raise StoreError(f"{path}: {_chunk(name)} holds {found} bytes, expected {expected}")
    return DiskColumn(chunk, dtype, length)


def _checked(
    path: Path, chunk: StoredKey | None, name: str, meta: Mapping[str, Any]
) -> np.ndarray:
    """Read a whole plain column, and compare its checksum."""
    column = _disk_column(path, chunk, name, meta)
    if chunk is None or not len(column):
        return np.empty(0, column.dtype)
    data = chunk.read()
    values, checksum = data[:-CHECKSUM_BYTES], data[-CHECKSUM_BYTES:]
    if google_crc32c.value(values) != int.from_bytes(checksum, "little"):
        raise StoreError(f"{path}: {_chunk(name)} is damaged: its checksum does not match")
    return np.frombuffer(bytearray(values), column.dtype)


def _chunk(name: str) -> str:
    return f"{name}/c/0"


def _json(path: Path, keys: Mapping[str, StoredKey], key: str) -> dict[str, Any]:
    if key not in keys:
        raise StoreError(f"{path} lacks {key}; `infgen verify` lists damage")
    try:
        loaded: dict[str, Any] = json.loads(keys[key].read())
    except ValueError as error:
        raise StoreError(f"{path}: {key} is damaged: {error}") from error
    return loaded
