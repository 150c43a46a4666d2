"""Atomic writes: a reader sees a whole file or folder or none, whenever a writer is killed.

Everything is synced to disk before it gets its final name.
"""

import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pipeline.engine import signals

MANIFEST = "manifest.json"
"""Written last: a folder that has one is complete."""
PARTIAL = ".partial"
"""Ending of the names of files and folders that are still being written."""
TRASH = "trash."
"""Beginning of the names of folders that are being removed; they end in ``PARTIAL``."""


_MIB = 1 << 20
_FULL = (errno.ENOSPC, errno.EDQUOT)
_REFUSALS = (*_FULL, errno.EROFS)


class StoreError(ValueError):
    """A file or folder that is missing, damaged or of another schema."""


class DiskError(OSError):
    """The file system refuses a write: it is full, over its quota, or read-only."""


@contextmanager
def naming_refusals(path: Path, begun: Path | None = None) -> Iterator[None]:
    """Turn a write that the file system refuses into an error that says what is needed.

    Args:
        path: Final path of what is written.
        begun: What is written of it so far; None if nothing is.

    Raises:
        DiskError: naming the path, its size so far, the free space and the way out.
    """
    try:
        yield
    except Exception as error:
        number = _refusal(error)
        if number is None:
            raise
        raise DiskError(_refused(path, begun, number)) from error


def _refusal(error: BaseException | None) -> int | None:
    """Return the number of the refusal that an error is, or comes from.

    Errors of libraries carry only its text.
    """
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        for number in _REFUSALS:
            if os.strerror(number) in str(error):
                return number
        error = error.__cause__ or error.__context__
    return None


def _refused(path: Path, begun: Path | None, number: int) -> str:
    what = f"{path} cannot be written: {os.strerror(number)}"
    if number not in _FULL:
        return f"{what}; make it writable, or name another --root"
    place = next(folder for folder in path.parents if folder.exists())
    disk, files = shutil.disk_usage(place), os.statvfs(place)
    written = 0 if begun is None else _size(begun)
    if number == errno.EDQUOT:  # What is free of a quota is not told.
        needs = f"it needs more than the {written / _MIB:.3g} MiB written so far"
    elif files.f_files and not files.f_favail:
        needs = f"all {files.f_files} files (inodes) that the disk can hold are in use"
    else:
        needs = (
            f"it needs more than {(written + disk.free) / _MIB:.3g} MiB (written "
            f"{written / _MIB:.3g}, free {disk.free / _MIB:.3g} of {disk.total / _MIB:.3g})"
        )
    return f"{what}; {needs}; make room there and run again: what is finished is kept"


def _size(path: Path) -> int:
    """Bytes of a file, or of all files below a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


@contextmanager
def publish(target: Path, *, resume: bool = False) -> Iterator[Path]:
    """Give a temporary folder to write in, and rename it to ``target`` at the end.

    A reader sees the whole folder or none of it. Where two processes do the same work, the
    first to finish wins and the other's folder is removed.

    Args:
        target: Final path of the folder.
        resume: Start from what a killed attempt left, without its half-written files. Only
            one process may write then.

    Raises:
        DiskError: if the file system refuses a write, also one of the block.
        StoreError: if the folder was removed meanwhile, or another without a manifest is
            in its place.
    """
    mark = "" if resume else f".{uuid.uuid4().hex[:8]}"
    partial = target.with_name(f"{target.name}{mark}{PARTIAL}")
    with naming_refusals(target):
        partial.mkdir(parents=True, exist_ok=resume)
    if resume:
        _remove_partial_files(partial)
    handle = os.open(partial, os.O_RDONLY)
    try:
        with naming_refusals(target, begun=partial):
            yield partial
            sync_tree(partial)
            with signals.uninterrupted():
                _check_not_replaced(handle, partial)
                _rename_unless_finished(partial, target)
    finally:
        os.close(handle)
        if not resume:
            shutil.rmtree(partial, ignore_errors=True)


def _remove_partial_files(folder: Path) -> None:
    for path in sorted(folder.rglob(f"*{PARTIAL}")):
        if path.is_file():
            path.unlink()


def _check_not_replaced(handle: int, partial: Path) -> None:
    """Check that the folder is still the one that this process made.

    Another run may have removed it, and later writes may have made a new one with a part of
    the files. The open handle keeps its inode from being reused.
    """
    own = False
    with suppress(FileNotFoundError):
        own = os.path.samestat(os.fstat(handle), partial.stat())
    if not own:
        raise StoreError(f"{partial} was removed by another run while it was written")


def _rename_unless_finished(partial: Path, target: Path) -> None:
    try:
        partial.rename(target)
    except OSError as error:
        if not target.is_dir():
            raise
        if not (target / MANIFEST).is_file():
            if not (partial / MANIFEST).is_file():
                raise StoreError(f"{target} is in the way; move it elsewhere") from error
            remove_folder(target)  # A killed process left it half removed.
            partial.rename(target)
    sync_folder(target.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder: rename it at once, then delete its contents as far as possible.

    A killed process so leaves no half of it under its name, and processes that still write
    in it no longer reach it. What cannot be deleted is left to the next run.
    """
    trash = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}{PARTIAL}")
    with suppress(FileNotFoundError):
        folder.rename(trash)
    shutil.rmtree(trash, ignore_errors=True)


def write_file(path: Path, data: bytes) -> None:
    """Write a small file atomically, and sync it.

    Raises:
        DiskError: if the file system refuses it; nothing of it is left then.
    """
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}{PARTIAL}")
    with naming_refusals(path), signals.uninterrupted():
        try:
            with partial.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with sorted keys: equal values are equal bytes."""
    write_file(path, (json.dumps(value, indent=1, sort_keys=True) + "\n").encode())


def sync_tree(root: Path) -> None:
    """Sync a folder and all files and folders below it to disk."""
    for folder, _, files in os.walk(root):
        for name in files:
            handle = os.open(os.path.join(folder, name), os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        sync_folder(Path(folder))


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
