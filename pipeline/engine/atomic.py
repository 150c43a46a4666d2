"""Writing so that a reader sees all of it or none of it, whenever the writer is killed.

Everything is on disk (synced) before it gets the name that readers look for.
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
"""Written last; a folder that has one is whole."""
PARTIAL = ".partial"
"""Ending of the names of files and folders that are still being written."""
TRASH = "trash."
"""Beginning of the names of folders that are being removed; they end in ``PARTIAL``."""


class StoreError(ValueError):
    """Something on disk that is missing, damaged or not what was expected."""


@contextmanager
def publish(target: Path, *, resume: bool = False) -> Iterator[Path]:
    """Give a folder to write in, and make it ``target`` only once all is written.

    A reader sees the whole folder or none of it; everything is on disk before the name is.
    Where two do the same work at once, the first to finish wins and the other's is dropped.

    Args:
        target: Where the folder shall stand.
        resume: Keep what an earlier, killed try left, instead of starting empty, but for
            files that were half written. There must be one writer then.

    Raises:
        StoreError: if the folder was removed meanwhile, or another that is not sealed
            stands in its place.
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
        with signals.whole():
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
    """Make sure that all of a folder was written by who began it.

    Another run may have removed it; what is written next makes it anew, with a part of the
    files. While the first is open, no other folder is taken for it.
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
            remove_folder(target)  # A kill left it half removed.
            partial.rename(target)
    sync_folder(target.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder: its name at once, what it holds as far as that can be.

    So a kill leaves no half of it under its name, and who still writes in it has lost it.
    What cannot be removed now is trash, for the next run to clear.
    """
    trash = folder.with_name(f"{TRASH}{uuid.uuid4().hex[:8]}{PARTIAL}")
    with suppress(FileNotFoundError):
        folder.rename(trash)
    shutil.rmtree(trash, ignore_errors=True)


def write_file(path: Path, data: bytes) -> None:
    """Write a small file whole or not at all, and sync it."""
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}{PARTIAL}")
    with signals.whole():
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
    for folder, _, files in os.walk(root):
        for name in files:
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
