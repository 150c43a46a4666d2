"""Fingerprints: the identity of source files by their content.

A plain TFRecord has two checksums per record. Their hash identifies the file as well as a
hash of all its bytes, in a thousandth of the time. Of GZIP files, which would have to be
unpacked, and of all other files all bytes are hashed.

A record with damaged data still has the checksum of the undamaged one, so a damaged and a
repaired file would have one identity. Once an ingest has found damage and the file is
repaired, it is therefore identified by all its bytes.
"""

import hashlib
import os
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import google_crc32c

from infgen.sources.remote import file_system
from infgen.sources.remote_files import is_url
from infgen.sources.tfrecord import Record, read_record
from pipeline.engine.atomic import MANIFEST, StoreError, write_json
from pipeline.engine.layout import Root, read_json

if TYPE_CHECKING:
    from infgen.sources.registry import FoundScene
    from infgen.sources.scene_files import Label

INGEST = "ingest"
"""The stage that reports damaged records ..."""
DAMAGED = "data checksum does not match"
"""... and the reason it gives."""
WHOLE = "sha256:"
"""Prefix of the identity of a file by all its bytes."""
BLOCK_BYTES = 1 << 22
HEADER_BYTES = 12
FOOTER_BYTES = 4
CRC_MASK_DELTA = 0xA282EAD8


class FingerprintCache:
    """Cache of the identities of local files, by path, size and time."""

    def __init__(self, root: Root) -> None:
        self._root, self._path = root, root.fingerprints
        self._known: dict[str, list[Any]] = _read_cache(self._path)
        self._changed = False

    def fingerprint(self, url: str) -> str:
        """Return the identity of a file; read it only if it has changed."""
        if is_url(url):
            return _fingerprint_remote(url)
        stat = os.stat(url)
        mark = [stat.st_size, stat.st_mtime_ns, stat.st_ino]
        known = self._known.get(url)
        if known is not None and known[:3] == mark:
            return str(known[3])
        before = "" if known is None else str(known[3])
        self._known[url] = [*mark, self._identity(Path(url), before)]
        self._changed = True
        return str(self._known[url][3])

    def label(self, scene: "FoundScene") -> "Label":
        """Return split and id of a scene file; read it only if it has changed."""
        from infgen.sources.scene_files import Label  # noqa: PLC0415

        url = scene.files.paths[0]
        identity = self.fingerprint(url)
        marks = [identity] if is_url(url) else self._known[url][:4]
        known = self._known.get(url, [])
        if known[: len(marks)] == marks and len(known) == len(Label._fields) + len(marks):
            return Label(*known[len(marks) :])
        found = scene.label
        self._known[url] = [*marks, *found]
        self._changed = True
        return found

    def _identity(self, path: Path, before: str) -> str:
        """Read a file's identity; all of it, if a record was damaged and is no more."""
        found = fingerprint(path)
        if found.startswith(WHOLE):
            return found
        damaged = self._damaged.get(found, ())
        repaired = any(isinstance(read_record(path, offset), Record) for offset in damaged)
        if not repaired and not before.startswith(WHOLE):
            return found
        whole = _hash_whole(path)
        return whole if repaired or whole == before else found

    @cached_property
    def _damaged(self) -> dict[str, set[int]]:
        """Offsets of records that an ingest found damaged, by their file's identity."""
        found: dict[str, set[int]] = defaultdict(set)
        for path in self._root.units(INGEST).glob(f"*/{MANIFEST}"):
            with suppress(
                StoreError, FileNotFoundError
            ):  # Another process may be removing it.
                unit = read_json(path)
                if unit["report"].get("quarantined"):
                    found[unit["inputs"]["source"]] |= _damaged_offsets(path.parent)
        return found

    def save(self) -> None:
        """Write the cache, unless the disk refuses it. Losing it costs only time."""
        if self._changed:
            with suppress(OSError):  # `infgen status` also works on a read-only root.
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_json(self._path, self._known)


def _damaged_offsets(unit: Path) -> set[int]:
    import polars as pl  # noqa: PLC0415

    rows = pl.read_parquet(unit / "quarantine.parquet")
    return set(rows.filter(pl.col("reason") == DAMAGED)["offset"])


def _read_cache(path: Path) -> dict[str, list[Any]]:
    try:
        known = read_json(path)
    except StoreError:
        return {}
    return known if isinstance(known, dict) else {}


def fingerprint_again(url: str, expected: str = "") -> str:
    """Return the present identity of a file, found in the way of an expected one."""
    if is_url(url):
        return _fingerprint_remote(url)
    return _hash_whole(Path(url)) if expected.startswith(WHOLE) else fingerprint(Path(url))


def fingerprint(path: Path) -> str:
    """Identity of a local file's content, independent of name and times."""
    with path.open("rb", buffering=0) as file:
        marks = _record_marks(file.fileno(), path.stat().st_size)
    return f"tfrecord:{marks}" if marks is not None else _hash_whole(path)


def _hash_whole(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
    return f"{WHOLE}{digest.hexdigest()}"


def _record_marks(handle: int, size: int) -> str | None:
    """Hash the lengths and checksums of a plain, whole TFRecord; None if it is not one."""
    digest = hashlib.sha256()
    start = 0
    while start < size:
        header = os.pread(handle, HEADER_BYTES, start)
        if len(header) < HEADER_BYTES:
            return None
        length, crc = struct.unpack("<QI", header)
        if crc != _masked(google_crc32c.value(header[:8])):
            return None
        start += HEADER_BYTES + length + FOOTER_BYTES
        if start > size:  # A crafted length may be more than any file could hold.
            return None
        digest.update(header + os.pread(handle, FOOTER_BYTES, start - FOOTER_BYTES))
    return digest.hexdigest()


def _masked(crc: int) -> int:
    return ((crc >> 15 | crc << 17) + CRC_MASK_DELTA) & 0xFFFFFFFF


def _fingerprint_remote(url: str) -> str:
    """Identity of a remote file: its store's checksums or times, or else all its bytes."""
    system, path = file_system(url)
    said = sorted(_content_marks(system.info(path)))
    digest = hashlib.sha256(repr(said).encode())
    if not any(name != "size" for name, _ in said):
        with system.open(path, "rb") as file:
            while block := file.read(BLOCK_BYTES):
                digest.update(block)
    return f"remote:{digest.hexdigest()}"


CONTENT_MARKS = ("etag", "md5hash", "content_md5", "contentmd5", "crc32c", "checksum")
TIME_MARKS = ("mtime", "lastmodified", "last_modified", "last_commit")


def _content_marks(info: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Pick checksums if there are any, else times."""
    found = {name.lower(): str(value) for name, value in info.items() if value}
    marks = [name for name in CONTENT_MARKS if name in found]
    marks = marks or [name for name in TIME_MARKS if name in found]
    for name in ("size", *marks):
        if name in found:
            yield name, found[name]
