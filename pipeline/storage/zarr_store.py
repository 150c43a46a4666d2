"""Columns in Zarr groups, read whole or in parts.

Every array is one chunk. Without ``compress`` its only codec is crc32c: the chunk file is
the array followed by four bytes, and any part of it can be read alone. A missing chunk is
an error, never zeros. Zarr is imported in functions: it takes a second, and neither
``infgen status`` nor reading in parts needs it.
"""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pipeline.engine.atomic import StoreError, publish, write_file, write_json
from pipeline.storage.columns import Columns, PackedRecords, names, pack

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


class DiskColumn:
    """A column on disk, of which any part can be read; no file is kept open.

    Memory maps would keep a descriptor and a mapping each. Training samples scenes from all
    shards at once, and those of WOMD have 52,000 columns, while most systems allow a
    process 1,024 descriptors and 65,530 mappings.
    """

    __slots__ = ("_chunk", "_length", "dtype")

    def __init__(self, chunk: Path, dtype: np.dtype, length: int) -> None:
        self._chunk, self._length, self.dtype = str(chunk), length, dtype

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
        size = self.dtype.itemsize
        try:
            handle = os.open(self._chunk, os.O_RDONLY)
            try:
                data = os.pread(handle, (stop - start) * size, start * size)
            finally:
                os.close(handle)
        except OSError as error:
            raise StoreError(f"{self._chunk} cannot be read: {error}") from error
        if len(data) != (stop - start) * size:
            raise StoreError(f"{self._chunk} is cut short; `infgen verify` lists damage")
        return np.frombuffer(data, self.dtype)


def write_group(
    path: Path,
    columns: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
    *,
    compress: bool,
) -> None:
    """Write one-dimensional columns as a new Zarr v3 group.

    Zarr builds the group in memory, and its files are then written directly: Zarr's own
    local store starts a thread per file access, which doubles the time.

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
    path.mkdir(parents=True)
    for key, data in files.items():
        (path / key).parent.mkdir(parents=True, exist_ok=True)
        (path / key).write_bytes(data.as_numpy_array().data)


def read_group(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all columns and the attributes of a group, checksums verified.

    Raises:
        StoreError: if a chunk is missing, cut short or damaged.
    """
    import zarr  # noqa: PLC0415

    _json(path / "zarr.json")
    columns = {}
    try:
        group = zarr.open_group(path, mode="r")
        arrays = sorted(group.arrays())
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    for name, array in arrays:
        chunk = _chunk(path, name)
        if array.size and not chunk.is_file():
            raise StoreError(f"{chunk} is missing; `infgen verify` lists damage")
        try:
            columns[name] = np.asarray(array[:])
        except (ValueError, RuntimeError) as error:
            raise StoreError(f"{chunk} is damaged: {error}") from error
    return columns, dict(group.attrs)


def open_group(path: Path) -> tuple[dict[str, DiskColumn], dict[str, Any]]:
    """Open the columns of an uncompressed group without reading them.

    Raises:
        StoreError: if the group is compressed, or a chunk is missing or cut short.
    """
    about = _json(path / "zarr.json")
    columns = {}
    for meta_file in sorted(path.glob("*/zarr.json")):
        meta = _json(meta_file)
        name, dtype = meta_file.parent.name, np.dtype(meta["data_type"])
        if [codec["name"] for codec in meta["codecs"]] != ["bytes", "crc32c"]:
            raise StoreError(
                f"{meta_file.parent} is compressed and cannot be read in parts"
            )
        columns[name] = _disk_column(_chunk(path, name), dtype, int(meta["shape"][0]))
    return columns, about.get("attributes", {})


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


def _disk_column(chunk: Path, dtype: np.dtype, length: int) -> DiskColumn:
    expected = length * dtype.itemsize + CHECKSUM_BYTES
    found = chunk.stat().st_size if chunk.is_file() else None
    if length and found != expected:
        raise StoreError(f"{chunk} holds {found} bytes, expected {expected}")
    return DiskColumn(chunk, dtype, length)


def _chunk(path: Path, name: str) -> Path:
    return path / name / "c" / "0"


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise StoreError(f"{path} is missing")
    try:
        loaded: dict[str, Any] = json.loads(path.read_bytes())
    except ValueError as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    return loaded
