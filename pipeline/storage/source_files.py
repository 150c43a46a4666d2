"""Source files: found by path, pattern or URL, and identified by their content.

A plain TFRecord has two checksums per record. Their hash identifies the file as well as a
hash of all its bytes, in a thousandth of the time. Of GZIP files, which would have to be
unpacked, and of all other files all bytes are hashed.

A record with damaged data still has the checksum of the undamaged one, so a damaged and a
repaired file would have one identity. Once an ingest has found damage and the file is
repaired, it is therefore identified by all its bytes.
"""

import glob
import hashlib
import os
import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import google_crc32c

from infgen.errors import ConfigError
from infgen.sources.remote import file_system
from infgen.sources.tfrecord import Record, read_record
from pipeline.engine.atomic import MANIFEST, StoreError, write_json
from pipeline.engine.layout import Root, read_json
from pipeline.engine.stage import Source

BUILTIN = "builtin"
"""Names the synthetic records of the package."""
INGEST = "ingest"
"""The stage that reports damaged records ..."""
DAMAGED = "data checksum does not match"
"""... and the reason it gives."""
WHOLE = "sha256:"
"""Prefix of the identity of a file by all its bytes."""
BLOCK_BYTES = 1 << 22
RECORDS_IN_FOLDER = "*.tfrecord*"
HEADER_BYTES = 12
FOOTER_BYTES = 4
CRC_MASK_DELTA = 0xA282EAD8


def find_sources(patterns: Sequence[str], root: Root) -> tuple[Source, ...]:
    """Find source files and their identities, in the order of their names.

    Args:
        patterns: Paths, folders, glob patterns, fsspec URLs, or ``builtin``.
        root: Root that caches identities.

    Raises:
        ConfigError: if a pattern matches nothing, or two files have one name.
    """
    if not patterns:
        raise ConfigError("no records are named; --records 'DIR/*.tfrecord*' names them")
    urls = find_urls(patterns)
    _refuse_equal_names(urls)
    memory = _FingerprintCache(root)
    found = [Source(url, _name(url), memory.fingerprint(url)) for url in urls]
    memory.save()
    return tuple(sorted(found, key=lambda source: source.name))


def find_urls(patterns: Sequence[str]) -> list[str]:
    """Find files by path, folder, pattern or URL, each once, in order.

    Raises:
        ConfigError: if a pattern matches nothing.
    """
    return sorted({url for pattern in patterns for url in _matches(pattern)})


def absolute(pattern: str) -> str:
    """Make a local path or pattern independent of the current folder."""
    pattern = pattern.removeprefix("file://")
    if "://" in pattern or pattern == BUILTIN:
        return pattern
    return os.path.abspath(os.path.expanduser(pattern))


def _matches(pattern: str) -> list[str]:
    if pattern == BUILTIN:
        from infgen.sources.towns import builtin_records  # noqa: PLC0415

        return [str(path) for path in builtin_records()]
    found = _remote(pattern) if "://" in pattern else _local(absolute(pattern))
    if not found:
        raise ConfigError(
            f"no records match {pattern}; expected TFRecord files of WOMD Scenario protos, "
            "as --records 'DIR/*.tfrecord*' or the variable INFGEN_RECORDS names them"
        )
    return found


def _local(pattern: str) -> list[str]:
    if os.path.isdir(pattern):
        pattern = os.path.join(glob.escape(pattern), RECORDS_IN_FOLDER)
    if os.path.isfile(pattern):
        return [pattern]
    return [path for path in glob.glob(pattern, recursive=True) if os.path.isfile(path)]


def _remote(pattern: str) -> list[str]:
    system, path = file_system(pattern)
    if glob.has_magic(path):
        paths = system.glob(path)
    else:
        paths = [path] if system.isfile(path) else []
    return [str(system.unstrip_protocol(found)) for found in paths]


def _name(url: str) -> str:
    return url.rsplit("/", 1)[-1]


def _refuse_equal_names(urls: Sequence[str]) -> None:
    by_name = defaultdict(list)
    for url in urls:
        by_name[_name(url)].append(url)
    for name, twins in by_name.items():
        if len(twins) > 1:
            raise ConfigError(
                f"two source files are named {name}: {twins[0]} and {twins[1]}; rename one"
            )


class _FingerprintCache:
    """Cache of the identities of local files, by path, size and time."""

    def __init__(self, root: Root) -> None:
        self._root, self._path = root, root.fingerprints
        self._known: dict[str, list[Any]] = _read_cache(self._path)
        self._changed = False

    def fingerprint(self, url: str) -> str:
        """Return the identity of a file; read it only if it has changed."""
        if "://" in url:
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
        """Write the cache. Losing it costs only time."""
        if self._changed:
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
