"""The door to the disk: columns in Zarr, memory maps of them, whole-or-nothing folders.

Every array is one chunk. Where ``compress`` is off its only codec is crc32c, so the chunk
file is the array itself followed by four bytes, and ``map_group`` reads it without a copy.
A missing chunk is an error here, never zeros.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from pipeline.columns import Unpacked, pack

T = TypeVar("T")

CHECKSUM_BYTES = 4


class StoreError(ValueError):
    """A group on disk that is damaged or not what was expected."""


def write_group(
    path: Path,
    columns: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
    *,
    compress: bool,
) -> None:
    """Write one-dimensional columns as a new Zarr v3 group."""
    packed = BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle")
    codecs = [packed, Crc32cCodec()] if compress else [Crc32cCodec()]
    group = zarr.open_group(path, mode="w-", zarr_format=3, attributes=dict(attributes))
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


def read_group(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all columns and the attributes of a group, checksums verified.

    Raises:
        StoreError: if a chunk is missing, cut short or damaged.
    """
    columns = {}
    group = zarr.open_group(path, mode="r")
    for name, array in sorted(group.arrays()):
        if array.size and not _chunk(path, name).is_file():
            raise StoreError(
                f"{_chunk(path, name)} is missing; `infgen verify` lists damage"
            )
        try:
            columns[name] = np.asarray(array[:])
        except (ValueError, RuntimeError) as error:
            raise StoreError(f"{_chunk(path, name)} is damaged: {error}") from error
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
    return Unpacked(columns, kind)


def _map(chunk: Path, dtype: np.dtype, length: int) -> np.ndarray:
    if length == 0:
        return np.empty(0, dtype)
    expected = length * dtype.itemsize + CHECKSUM_BYTES
    found = chunk.stat().st_size if chunk.is_file() else None
    if found != expected:
        raise StoreError(f"{chunk} holds {found} bytes, expected {expected}")
    return np.memmap(chunk, dtype=dtype, mode="r", shape=(length,))


def _chunk(path: Path, name: str) -> Path:
    return path / name / "c" / "0"


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise StoreError(f"{path} is missing")
    loaded: dict[str, Any] = json.loads(path.read_text())
    return loaded


@contextmanager
def publish(target: Path, *, resume: bool = False) -> Iterator[Path]:
    """Give a folder to write in, and make it ``target`` only once all is written.

    A reader sees the whole folder or none of it; everything is on disk before the name is.

    Args:
        target: Where the folder shall stand; must not exist.
        resume: Keep what an earlier, killed try left, instead of clearing it.
    """
    partial = target.with_name(f"{target.name}.partial")
    if not resume:
        shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True, exist_ok=resume)
    yield partial
    sync_tree(partial)
    partial.rename(target)
    sync_folder(target.parent)


def write_file(path: Path, data: bytes) -> None:
    """Write a small file whole or not at all, and sync it."""
    partial = path.with_name(f"{path.name}.partial")
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    sync_folder(path.parent)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all, keys sorted, so equal values are equal bytes."""
    write_file(path, (json.dumps(value, indent=1, sort_keys=True) + "\n").encode())


def sync_tree(root: Path) -> None:
    """Put every file and folder below, and the folder itself, on disk."""
    for folder, _, names in os.walk(root):
        for name in names:
            handle = os.open(os.path.join(folder, name), os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        sync_folder(Path(folder))


def sync_folder(folder: Path) -> None:
    """Put a folder's own entries on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
