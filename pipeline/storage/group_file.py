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
from threading import Lock

from pipeline.engine.atomic import PARTIAL, StoreError

_TIME = (1980, 1, 1, 0, 0, 0)
_MODE = 0o100644 << 16
_LOCAL_HEADER = struct.Struct("<4s22xHH")
"""Of an entry: its mark, and how long the name and what follows it are."""
_MARK = b"PK\x03\x04"


@dataclass(frozen=True, slots=True)
class Extent:
    """Where the bytes of a key are.

    Attributes:
        offset: First byte in the file.
        length: Number of bytes.
    """

    offset: int
    length: int


class OpenedFile:
    """A file that is opened when a part of it is read.

    Between ``reading()`` and its end it stays open, however many parts are read; otherwise
    no descriptor is kept: training reads scenes of all shards at once, and those of WOMD
    are more files than most systems let a process open.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock, self._readers, self._handle = Lock(), 0, -1

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Keep the file open for several reads.

        Raises:
            StoreError: if it cannot be opened.
        """
        with self._lock:
            if not self._readers:
                self._handle = self._open()
            self._readers += 1
        try:
            yield
        finally:
            with self._lock:
                self._readers -= 1
                if not self._readers:
                    os.close(self._handle)

    def read(self, offset: int, length: int) -> bytes:
        """Read a part; shorter than asked for at the end of the file.

        Raises:
            StoreError: if it cannot be read.
        """
        with self.reading():
            try:
                return os.pread(self._handle, length, offset)
            except OSError as error:
                raise StoreError(f"{self.path} cannot be read: {error}") from error

    def _open(self) -> int:
        try:
            return os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise StoreError(f"{self.path} cannot be read: {error}") from error


@dataclass(frozen=True, slots=True)
class StoredKey:
    """The bytes of one key of a group."""

    file: OpenedFile
    extent: Extent

    @classmethod
    def nowhere(cls, path: Path) -> "StoredKey":
        """Return the key of an array without values, which has no bytes."""
        return cls(OpenedFile(path), Extent(0, 0))

    def read(self) -> bytes:
        """Read all of them.

        Raises:
            StoreError: if the file is missing or cut short.
        """
        data = self.file.read(self.extent.offset, self.extent.length)
        if len(data) != self.extent.length:
            raise StoreError(f"{self.file.path} is cut short; `infgen verify` lists damage")
        return data


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
            str(each.relative_to(path)): StoredKey(
                OpenedFile(each), Extent(0, each.stat().st_size)
            )
            for each in sorted(path.rglob("*"))
            if each.is_file()
        }
    file = OpenedFile(path)
    try:
        with zipfile.ZipFile(path) as archive:
            listed = archive.infolist()
    except FileNotFoundError as error:
        raise StoreError(f"{path} is missing") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    with file.reading():
        return {info.filename: StoredKey(file, _extent(file, info)) for info in listed}


def _extent(file: OpenedFile, info: zipfile.ZipInfo) -> Extent:
    """Find the bytes of an entry behind its own header."""
    header = file.read(info.header_offset, _LOCAL_HEADER.size)
    if len(header) < _LOCAL_HEADER.size or info.compress_type != zipfile.ZIP_STORED:
        raise StoreError(f"{file.path} is damaged: {info.filename} is not stored plainly")
    mark, name, more = _LOCAL_HEADER.unpack(header)
    if mark != _MARK:
        raise StoreError(f"{file.path} is damaged: {info.filename} is not where it is said")
    offset = info.header_offset + _LOCAL_HEADER.size + name + more
    return Extent(offset, info.file_size)
