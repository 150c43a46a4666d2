"""Atomic writes: a reader sees a whole file or folder or none, whenever a writer is killed.

Everything is synced to disk before it gets its final name.
"""

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


class StoreError(ValueError):
    """A file or folder that is missing, damaged or of another schema."""


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
        StoreError: if the folder was removed meanwhile, or another without a manifest is
            in its place.
    """
    mark = "" if resume else f".{uuid.uuid4().hex[:8]}"
    partial = target.with_name(f"{target.name}{mark}{PARTIAL}")
    partial.mkdir(parents=True, exist_ok=resume)
    if resume:
        _remove_partial_files(partial)
    handle = os.open(partial, os.O_RDONLY)
    try:
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
    """Write a small file atomically, and sync it."""
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}{PARTIAL}")
    with signals.uninterrupted():
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
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
