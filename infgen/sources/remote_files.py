"""Files of scenes that are not on this machine, brought here as far as they are needed.

Sources read local files only. What a URL names is copied to a temporary folder, below
folders of the same names, from which splits are told.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from infgen.sources.remote import file_system
from infgen.sources.scene_files import MAX_FILE_BYTES, SceneFiles

HEAD_BYTES = 4096
"""Bytes at the start of a file that are read to tell what it is."""
_ABOVE = ("_", "_")
"""Folders above a copy, so that no name of a temporary folder is taken for a split."""


def is_url(path: str) -> bool:
    """Tell a URL of fsspec from a local path."""
    return "://" in path


def file_bytes(path: str) -> int:
    """Return the length of a file, local or not.

    Raises:
        OSError: if there is no such file.
    """
    if not is_url(path):
        return os.stat(path).st_size
    system, inner = file_system(path)
    return int(system.size(inner) or 0)


@contextmanager
def fetched(files: SceneFiles) -> Iterator[SceneFiles]:
    """Give local copies of a scene's files, for as long as the context lasts.

    Files that are local are given as they are.

    Raises:
        OSError: if a file cannot be read.
    """
    if not any(is_url(path) for path in files.paths):
        yield files
        return
    with temporary_folder() as folder:
        copies = tuple(str(_copy(url, folder)) for url in files.paths)
        yield SceneFiles(files.name, copies)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Give a folder whose name, and that of the one above, says nothing."""
    with TemporaryDirectory(prefix="infgen-") as top:
        folder = Path(top, *_ABOVE)
        folder.mkdir(parents=True)
        yield folder


def place(folder: Path, inner: str) -> Path:
    """Return where a file or folder of a file system is copied to, below a folder."""
    parts = [part for part in PurePosixPath(inner).parts if part not in ("/", ".", "..")]
    return folder.joinpath(*parts)


def read_heads(system: Any, sizes: Iterable[tuple[str, int]]) -> list[bytes]:
    """Read the first bytes of some files at once; none of what cannot be read.

    Args:
        system: Their fsspec file system.
        sizes: Path and length of each.
    """
    wanted = [(path, min(size, HEAD_BYTES)) for path, size in sizes]
    some = [(path, size) for path, size in wanted if size]
    paths, ends = [path for path, _ in some], [size for _, size in some]
    read: Sequence[Any] = (
        system.cat_ranges(paths, [0] * len(paths), ends, on_error="return") if some else ()
    )
    heads = dict(zip(paths, read, strict=True))
    found = [heads.get(path, b"") for path, _ in wanted]
    return [head if isinstance(head, bytes) else b"" for head in found]


def _copy(url: str, folder: Path) -> Path:
    """Copy a file, as far as it may be long; what reads it refuses a longer one."""
    system, inner = file_system(url)
    target = place(folder, inner)
    target.parent.mkdir(parents=True, exist_ok=True)
    with system.open(inner, "rb") as file:
        target.write_bytes(file.read(MAX_FILE_BYTES + 1))
    return target
