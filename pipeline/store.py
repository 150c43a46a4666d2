"""The door to the disk: columns in Zarr, and memory maps of them.

Every array is one chunk. Where ``compress`` is off its only codec is crc32c, so the chunk
file is the array itself followed by four bytes, and ``map_group`` reads it without a copy.
A missing chunk is an error here, never zeros. Zarr is imported where it is used: it takes a
second, and neither ``infgen status`` nor mapped reading needs it.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pipeline.columns import Unpacked, names, pack
from pipeline.folders import StoreError, publish, write_file, write_json

__all__ = [
    "StoreError",
    "map_group",
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


def write_group(
    path: Path,
    columns: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
    *,
    compress: bool,
) -> None:
    """Write one-dimensional columns as a new Zarr v3 group.

    Zarr lays the group out in memory and the files are written from there: its own way to
    the disk wakes a thread for every file it looks at, which costs as much again.

    Raises:
        FileExistsError: if the path exists.
    """
    import zarr  # noqa: PLC0415
    from zarr.codecs import BloscCodec, Crc32cCodec  # noqa: PLC0415
    from zarr.storage import MemoryStore  # noqa: PLC0415

    # Level 5 takes five times as long and saves a twelfth of the bytes of scenes.
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


def map_group(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Map the columns of an uncompressed group into memory, without reading them.

    Raises:
        StoreError: if the group is compressed, or a chunk is missing or cut short.
    """
    about = _json(path / "zarr.json")
    columns = {}
    for meta_file in sorted(path.glob("*/zarr.json")):
        meta = _json(meta_file)
        name, dtype = meta_file.parent.name, np.dtype(meta["data_type"])
        if [codec["name"] for codec in meta["codecs"]] != ["bytes", "crc32c"]:
            raise StoreError(f"{meta_file.parent} is compressed and cannot be mapped")
        columns[name] = _map(_chunk(path, name), dtype, int(meta["shape"][0]))
    return columns, about.get("attributes", {})


def write_records(
    path: Path, records: Sequence[Any], kind: type, schema: str, *, compress: bool
) -> None:
    """Write records of one type as a group; ``schema`` names their layout and version."""
    attributes = {"schema": schema, "count": len(records)}
    write_group(path, pack(records, kind), attributes, compress=compress)


def read_records(path: Path, kind: type[T], schema: str, *, mapped: bool) -> Unpacked[T]:
    """Open a group of records: all read and verified, or mapped and read on demand.

    Raises:
        StoreError: if the group holds another schema, or is damaged.
    """
    columns, attributes = (map_group if mapped else read_group)(path)
    if attributes.get("schema") != schema:
        found = attributes.get("schema")
        raise StoreError(
            f"{path} holds {found!r}, expected {schema!r}; run its stage again"
        )
    lost = sorted(names(kind) - columns.keys())
    if lost:
        raise StoreError(f"{path} lacks {', '.join(lost)}; `infgen verify` lists damage")
    return Unpacked(columns, kind)


def _map(chunk: Path, dtype: np.dtype, length: int) -> np.ndarray:
    if length == 0:
        return np.empty(0, dtype)
    expected = length * dtype.itemsize + CHECKSUM_BYTES
    found = chunk.stat().st_size if chunk.is_file() else None
    if found != expected:
        raise StoreError(f"{chunk} holds {found} bytes, expected {expected}")
    # A plain view of the map: slicing a memmap object costs ten times as much.
    return np.asarray(np.memmap(chunk, dtype=dtype, mode="r", shape=(length,)))


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
