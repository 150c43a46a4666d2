"""TFRecord files as a stream of checked records, with every fault named.

A record is ``length: u64 | masked crc32c(length): u32 | data | masked crc32c(data): u32``,
all little-endian; a file is records end to end, plain or GZIP. Memory is bounded whatever
the file says about itself.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import google_crc32c

from infgen.sources.remote import file_system

MAX_RECORD_BYTES = 128 << 20
"""Longer records are refused; the largest real scenario is about 5 MB."""

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")
_BLOCK_BYTES = 1 << 16
_GZIP_MAGIC = b"\x1f\x8b"

_OTHER_FORMATS = {
    b"PK\x03\x04": "a zip archive: unpack it first",
    b"PK\x05\x06": "an empty zip archive",
    b"\x28\xb5\x2f\xfd": "a zstd file: unpack it first",
    b"BZh": "a bzip2 file: unpack it first",
    b"\xfd7zXZ": "an xz file: unpack it first",
    b"\x89HDF": "an HDF5 file",
    b"PAR1": "a Parquet file",
    b"<": "a web page or XML text",
    b"{": "JSON text",
    b"version https://git-lfs": "a Git LFS pointer: fetch the real file",
}


@dataclass(frozen=True, slots=True)
class Record:
    """One record whose checksums hold.

    Attributes:
        number: Position in the file, counted from 0.
        offset: Of its first header byte, in the uncompressed stream.
        data: What it holds.
    """

    number: int
    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class BadRecord:
    """One record that cannot be used, or the unreadable rest of a file.

    Attributes:
        number: Position in the file, counted from 0.
        offset: Of its first header byte, in the uncompressed stream.
        reason: What is wrong with it.
    """

    number: int
    offset: int
    reason: str


class RecordError(ValueError):
    """A record that is no usable scene; the message is the reason."""


@runtime_checkable
class ByteSource(Protocol):
    """An open file, local or remote."""

    def read(self, size: int, /) -> bytes:
        """Return up to so many bytes; none at the end."""


class _StreamError(ValueError):
    """The compressed stream below the records is damaged."""


def masked_crc(data: bytes) -> int:
    """Checksum of TFRecord: crc32c, rotated and shifted so that it can be nested."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def frame(data: bytes) -> bytes:
    """Wrap data as one TFRecord record. Inverse of ``iter_records``."""
    length = struct.pack("<Q", len(data))
    ends = _FOOTER.pack(masked_crc(length)), _FOOTER.pack(masked_crc(data))
    return length + ends[0] + data + ends[1]


def open_bytes(url: str | Path) -> AbstractContextManager[ByteSource]:
    """Open a local path or any fsspec URL for reading."""
    if "://" not in str(url):
        return Path(url).open("rb")
    system, path = file_system(str(url))
    opened: AbstractContextManager[ByteSource] = system.open(path, "rb")
    return opened


def iter_records(
    url: str | Path, *, max_bytes: int = MAX_RECORD_BYTES
) -> Iterator[Record | BadRecord]:
    """Stream the records of a plain or GZIP TFRecord.

    A record whose data is damaged is one bad record, and reading goes on after it. Where
    the next record can no longer be found (damaged length, file or GZIP stream cut short)
    one bad record stands for the rest. Faults of the disk or the network are raised.

    Args:
        url: Local path or fsspec URL.
        max_bytes: Longer records are skipped as bad.

    Yields:
        Every record in order, usable or bad.

    Raises:
        OSError: if the file cannot be opened or read.
    """
    with open_bytes(url) as file:
        yield from _records(_Reader(_unpacked(file)), max_bytes)


def read_record(url: str | Path, offset: int) -> Record | BadRecord:
    """Read one record again, by the offset that ``iter_records`` gave it.

    Its number is not known and given as 1.

    Raises:
        OSError: if the file cannot be opened or read.
    """
    with open_bytes(url) as file:
        reader = _Reader(_unpacked(file))
        try:
            reader.skip(offset)
            record, _, _ = _next(reader, 1, offset, MAX_RECORD_BYTES)
        except _StreamError as error:
            record = BadRecord(1, offset, str(error))
    return record or BadRecord(1, offset, "the file ends before the record")


def _records(reader: "_Reader", max_bytes: int) -> Iterator[Record | BadRecord]:
    number = offset = 0
    while True:
        try:
            record, size, goes_on = _next(reader, number, offset, max_bytes)
        except _StreamError as error:
            record, size, goes_on = BadRecord(number, offset, str(error)), 0, False
        if record is not None:
            yield record
        if not goes_on:
            return
        number, offset = number + 1, offset + size


def _next(
    reader: "_Reader", number: int, offset: int, max_bytes: int
) -> tuple[Record | BadRecord | None, int, bool]:
    """Read one record: it (None at the end), its framed size, whether more may follow."""
    header = reader.take(_HEADER.size)
    if not header and number:
        return None, 0, False
    reason = _header_fault(header, first=number == 0)
    if reason:
        return BadRecord(number, offset, reason), 0, False
    (length, _) = _HEADER.unpack(header)
    size = _HEADER.size + length + _FOOTER.size
    if length > max_bytes:
        whole = reader.skip(length + _FOOTER.size)
        reason = f"record of {length} bytes is longer than the limit of {max_bytes}"
        return BadRecord(number, offset, reason), size, whole
    body = reader.take(length + _FOOTER.size)
    if len(body) < length + _FOOTER.size:
        held = f"{_HEADER.size + len(body)} of {size} bytes"
        return BadRecord(number, offset, f"file ends inside the record: {held}"), 0, False
    data = body[:length]
    if _FOOTER.unpack_from(body, length)[0] != masked_crc(data):
        return BadRecord(number, offset, "data checksum does not match"), size, True
    return Record(number, offset, data), size, True


def _header_fault(header: bytes, *, first: bool) -> str:
    """Say what is wrong with a record's header; nothing if it is sound."""
    if not header:
        return "file is empty"
    if is_record_header(header):
        return ""
    for magic, what in _OTHER_FORMATS.items() if first else ():
        if header.startswith(magic[: _HEADER.size]):
            return f"not a TFRecord but {what}"
    if len(header) < _HEADER.size:
        return f"file ends inside a record's header: {len(header)} of {_HEADER.size} bytes"
    return "length checksum does not match" + (": not a TFRecord?" if first else "")


def is_record_header(head: bytes) -> bool:
    """Tell whether some bytes start a record: a length, and its checksum."""
    if len(head) < _HEADER.size:
        return False
    return bool(_HEADER.unpack_from(head)[1] == masked_crc(head[:8]))


def _unpacked(file: ByteSource) -> "_Plain | _Gunzip":
    """Look at the first bytes and gunzip if need be.

    A plain file may start like a GZIP one: its first record need only be 559,903 bytes
    long. A sound header is therefore believed first.
    """
    head = file.read(_HEADER.size)
    if head.startswith(_GZIP_MAGIC) and not is_record_header(head):
        return _Gunzip(file, head)
    return _Plain(file, head)


class _Plain:
    """The bytes of a file as they are."""

    def __init__(self, file: ByteSource, head: bytes) -> None:
        self._file, self._head = file, head

    def some(self) -> bytes:
        """Return the next bytes; none at the end."""
        head, self._head = self._head, b""
        return head or self._file.read(_BLOCK_BYTES)


class _Gunzip:
    """The bytes of a GZIP file of one or more members, unpacked in bounded blocks."""

    def __init__(self, file: ByteSource, head: bytes) -> None:
        self._file, self._packed, self._fault = file, head, ""
        self._member = zlib.decompressobj(wbits=31)

    def some(self) -> bytes:
        """Return the next bytes; none at the end.

        Raises:
            _StreamError: if the stream is damaged or ends early, once all before it is out.
        """
        while True:
            if self._fault:
                raise _StreamError(self._fault)
            if self._member.eof and not self._next_member():
                return b""
            if not self._packed:
                self._packed = self._file.read(_BLOCK_BYTES)
                if not self._packed:
                    raise _StreamError("gzip stream ends early")
            if data := self._unpack():
                return data

    def _unpack(self) -> bytes:
        before = self._member.copy()
        try:
            data = self._member.decompress(self._packed, 4 * _BLOCK_BYTES)
        except zlib.error as error:
            self._fault = f"gzip stream is damaged: {error}"
            return _salvage(before, self._packed)
        self._packed = self._member.unconsumed_tail or self._member.unused_data
        return data

    def _next_member(self) -> bool:
        """Go on to the next member, past zero padding; False where the file ends."""
        while not (rest := self._packed.lstrip(b"\0")):
            self._packed = self._file.read(_BLOCK_BYTES)
            if not self._packed:
                return False
        rest += self._file.read(1) if len(rest) < len(_GZIP_MAGIC) else b""
        if not rest.startswith(_GZIP_MAGIC):
            raise _StreamError("bytes after the end of the gzip stream are not gzip")
        self._packed, self._member = rest, zlib.decompressobj(wbits=31)
        return True


def _salvage(member: "zlib._Decompress", packed: bytes) -> bytes:
    """Unpack byte by byte what comes before the damage, where the records may be sound."""
    parts = []
    with suppress(zlib.error):
        for at in range(len(packed)):
            parts.append(member.decompress(packed[at : at + 1]))
    return b"".join(parts)


class _Reader:
    """Exact numbers of bytes out of blocks of any size, never more than asked in memory."""

    def __init__(self, blocks: _Plain | _Gunzip) -> None:
        self._blocks, self._block, self._at = blocks, b"", 0

    def take(self, size: int) -> bytes:
        """Return so many bytes, fewer only at the end."""
        return b"".join(self._parts(size))

    def skip(self, size: int) -> bool:
        """Pass over so many bytes; False where the end comes first."""
        return sum(len(part) for part in self._parts(size)) == size

    def _parts(self, size: int) -> Iterator[bytes]:
        while size:
            if self._at == len(self._block):
                self._block, self._at = self._blocks.some(), 0
                if not self._block:
                    return
            part = self._block[self._at : self._at + size]
            self._at += len(part)
            size -= len(part)
            yield part
