"""Locks: one run at a time per stage. The system releases a lock when its process ends."""

import errno
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.engine.atomic import naming_refusals

POLL_S = 0.1
LOCK_TIMEOUT_S = 0.5
"""A lock counts as held after so long; ``is_locked`` takes it for a moment."""


_UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class LockedError(ValueError):
    """Another run holds the lock."""


class UnsupportedLockError(OSError):
    """The file system has no locks (``flock``)."""


@contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a lock file during the block.

    Args:
        path: The file; it is never removed.
        wait: Wait until it is free.

    Raises:
        DiskError: if the file system refuses to write it.
        LockedError: if another run holds it and ``wait`` is off, naming host, process and
            start.
        UnsupportedLockError: if the file system has no locks.
    """
    with naming_refusals(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        begun = time.monotonic()
        while not _try_lock(path, handle, fcntl.LOCK_EX):
            if not wait and time.monotonic() - begun > LOCK_TIMEOUT_S:
                raise LockedError(_locked_message(path))
            time.sleep(POLL_S)
        os.ftruncate(handle, 0)
        with naming_refusals(path):
            os.pwrite(handle, json.dumps(_this_process()).encode(), 0)
        yield
        os.ftruncate(handle, 0)
    finally:
        os.close(handle)


def is_locked(path: Path) -> bool:
    """Whether some process holds a lock; none does where there are no locks."""
    if not path.is_file():
        return False
    handle = os.open(path, os.O_RDONLY)  # Works without write permission.
    try:
        return not _try_lock(path, handle, fcntl.LOCK_SH)
    except UnsupportedLockError:
        return False
    finally:
        os.close(handle)


def holder(path: Path) -> dict[str, Any]:
    """Host, process and start of the run that holds a lock; empty if unknown."""
    try:
        about = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}


def _try_lock(path: Path, handle: int, kind: int) -> bool:
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            return False
        if error.errno in _UNSUPPORTED:
            raise UnsupportedLockError(
                f"{path} cannot be locked: {error.strerror}; a root must be on a file "
                "system with flock, or two runs would undo each other's work: mount this "
                "one with locks, or name another --root"
            ) from error
        raise
    return True


def _this_process() -> dict[str, Any]:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"host": socket.gethostname(), "pid": os.getpid(), "since": now}


def _locked_message(path: Path) -> str:
    about = holder(path)
    who = "another process"
    if about:
        who = f"process {about['pid']} on {about['host']} since {about['since']}"
    return f"{path.parent.name} is being made by {who}; --wait queues behind it ({path})"
