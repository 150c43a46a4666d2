"""Writing so that a reader sees all of it or none of it, whenever the writer is killed.

Everything is on disk (synced) before it gets the name that readers look for.
"""

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline import stopping

PARTIAL = ".partial"
"""Ending of the names of files and folders that are still being written."""


class StoreError(ValueError):
    """Something on disk that is missing, damaged or not what was expected."""


@contextmanager
def publish(target: Path, *, resume: bool = False) -> Iterator[Path]:
    """Give a folder to write in, and make it ``target`` only once all is written.

    A reader sees the whole folder or none of it; everything is on disk before the name is.
    Where two do the same work at once, the first to finish wins and the other's is dropped.

    Args:
        target: Where the folder shall stand.
        resume: Keep what an earlier, killed try left, instead of starting empty. There must
            be one writer then.
    """
    mark = "" if resume else f".{uuid.uuid4().hex[:8]}"
    partial = target.with_name(f"{target.name}{mark}{PARTIAL}")
    partial.mkdir(parents=True, exist_ok=resume)
    try:
        yield partial
        sync_tree(partial)
        with stopping.whole():
            _rename_first(partial, target)
    finally:
        if not resume:
            shutil.rmtree(partial, ignore_errors=True)


def _rename_first(partial: Path, target: Path) -> None:
    try:
        partial.rename(target)
    except OSError:
        if not target.is_dir():
            raise
    sync_folder(target.parent)


def write_file(path: Path, data: bytes) -> None:
    """Write a small file whole or not at all, and sync it."""
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}{PARTIAL}")
    with stopping.whole():
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
