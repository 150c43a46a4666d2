"""Whether this machine, and the root's disk, can do what a run needs."""

import os
import platform
import shutil
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from pipeline.engine.layout import Root, link
from pipeline.engine.locks import LockedError, is_locked, locked

PACKAGES = ("numpy", "torch", "zarr", "polars", "dask", "distributed", "typer", "rich")
FREE_BYTES = 10 << 30
GIB = 1 << 30


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at.

    Attributes:
        what: Its name.
        state: ``warn`` where a run can do without.
        note: What was found.
    """

    what: str
    state: Literal["ok", "warn", "bad"]
    note: str


def examine(root: Root) -> Iterator[Check]:
    """RootSnapshot at everything a run relies on."""
    yield Check("python", "ok", f"{platform.python_version()} on {platform.platform()}")
    for name in PACKAGES:
        yield _package(name)
    yield _device()
    yield Check("processors", "ok", f"{os.cpu_count()}")
    root.path.mkdir(parents=True, exist_ok=True)
    yield _disk(root.path)
    for what, trial in (("locks", _try_locks), ("links", _try_links)):
        yield _try(what, trial, root.path)


def _package(name: str) -> Check:
    try:
        return Check(name, "ok", metadata.version(name))
    except metadata.PackageNotFoundError:
        return Check(name, "bad", f"is not installed; pip install {name}")


def _device() -> Check:
    import torch  # noqa: PLC0415

    if not torch.cuda.is_available():
        return Check("gpu", "warn", "none; everything runs on processors, training slowly")
    count = torch.cuda.device_count()
    return Check("gpu", "ok", f"{count} x {torch.cuda.get_device_name(0)}")


def _disk(path: Path) -> Check:
    free = shutil.disk_usage(path).free
    note = f"{free / GIB:.1f} GiB free at {path}"
    return Check("disk", "ok" if free > FREE_BYTES else "warn", note)


def _try(what: str, trial: Callable[[Path], str], path: Path) -> Check:
    try:
        return Check(what, "ok", trial(path))
    except (OSError, LockedError) as error:
        return Check(what, "bad", f"{path}: {error}")


def _try_locks(path: Path) -> str:
    lock = path / f"doctor.{uuid.uuid4().hex[:8]}.lock"
    try:
        with locked(lock):
            if not is_locked(lock):
                raise LockedError("a lock that was taken does not hold: is this NFS?")
    finally:
        lock.unlink(missing_ok=True)
    return f"flock holds at {path}"


def _try_links(path: Path) -> str:
    name = path / f"doctor.{uuid.uuid4().hex[:8]}.link"
    try:
        link(name, path / "one")
        link(name, path / "two")
    finally:
        name.unlink(missing_ok=True)
    return f"links are replaced in one step at {path}"
