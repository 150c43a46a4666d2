"""A Zarr group in one file: an uncompressed zip archive, which Zarr itself reads.

A unit of work so is a handful of files, and its arrays are still read by their place in
them. Times and modes are fixed: equal groups are equal bytes. A folder that holds the same
keys as files, as groups were written before, is read alike.
"""

import os
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.atomic import PARTIAL, StoreError

_TIME = (1980, 1, 1, 0, 0, 0)
_MODE = 0o100644 << 16
_LOCAL_HEADER = struct.Struct("<4s22xHH")
"""Of an entry: its mark, and how long the name and what follows it are."""
_MARK = b"PK\x03\x04"


@dataclass(frozen=True, slots=True)
class StoredKey:
    """Where the bytes of one key of a group are.

    No file is kept open: training reads scenes of all shards at once, and those of WOMD are
    more files than most systems let a process open.

    Attributes:
        path: The file.
        offset: First byte in it.
        length: Number of bytes.
    """

    path: Path
    offset: int
    length: int

    def read(self, start: int = 0, length: int | None = None) -> bytes:
        """Read a part, or all that follows ``start``.

        Raises:
            StoreError: if the file is missing or cut short.
        """
        length = self.length - start if length is None else length
        with _opened(self.path) as handle:
            data = os.pread(handle, length, self.offset + start)
        if len(data) != length:
            raise StoreError(f"{self.path} is cut short; `infgen verify` lists damage")
        return data


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """Open a file for some reads.

    Raises:
        StoreError: if it cannot be opened or read.
    """
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            yield handle
        finally:
            os.close(handle)
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error}") from error


def write_group_file(path: Path, entries: Mapping[str, bytes]) -> None:
    """Write the keys of a group as a file, in their order.

    Raises:
        FileExistsError: if the path exists.
    """
    if path.exists():
        raise FileExistsError(path)
    partial = path.with_name(f"{path.name}{PARTIAL}")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for key, data in entries.items():
            info = zipfile.ZipInfo(key, _TIME)
            info.external_attr = _MODE
            archive.writestr(info, data)
    partial.rename(path)


def open_group_file(path: Path) -> dict[str, StoredKey]:
    """Find the keys of a group without reading their bytes.

    Raises:
        StoreError: if the file is missing, or is no uncompressed zip archive.
    """
    if path.is_dir():
        return {
            str(each.relative_to(path)): StoredKey(each, 0, each.stat().st_size)
            for each in sorted(path.rglob("*"))
            if each.is_file()
        }
    try:
        with zipfile.ZipFile(path) as archive:
            listed = archive.infolist()
    except FileNotFoundError as error:
        raise StoreError(f"{path} is missing") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    with _opened(path) as handle:
        return {info.filename: _stored(path, handle, info) for info in listed}


def _stored(path: Path, handle: int, info: zipfile.ZipInfo) -> StoredKey:
    """Find the bytes of an entry behind its own header."""
    header = os.pread(handle, _LOCAL_HEADER.size, info.header_offset)
    if len(header) < _LOCAL_HEADER.size or info.compress_type != zipfile.ZIP_STORED:
        raise StoreError(f"{path} is damaged: {info.filename} is not stored plainly")
    mark, name, more = _LOCAL_HEADER.unpack(header)
    if mark != _MARK:
        raise StoreError(f"{path} is damaged: {info.filename} is not where it is said")
    offset = info.header_offset + _LOCAL_HEADER.size + name + more
    return StoredKey(path, offset, info.file_size)
