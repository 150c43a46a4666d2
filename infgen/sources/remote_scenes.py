"""Finding scenes that are not on this machine: folders of any fsspec file system.

The sources look at a local folder of the same names, in which every file has only its first
bytes. Nothing else is read before a scene is.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from infgen.sources.registry import FoundScene, find_in
from infgen.sources.remote import file_system
from infgen.sources.remote_files import place, read_heads, temporary_folder
from infgen.sources.scene_files import SceneFiles


class _Listing(NamedTuple):
    """What a folder holds directly: lengths of files and names of folders, by name."""

    files: dict[str, int]
    folders: list[str]


def find_below_url(url: str) -> Iterator[FoundScene]:
    """Find the scenes in a remote folder and all folders below, in order.

    As ``registry.find_below``, what lies below a folder that is one scene is not looked at.

    Raises:
        OSError: if a folder cannot be listed.
    """
    system, folder = file_system(url)
    yield from _find_below(system, folder.rstrip("/"))


def find_in_url(url: str) -> list[FoundScene]:
    """Find the scenes that a remote folder holds directly, in order.

    Raises:
        OSError: if it cannot be listed.
    """
    system, folder = file_system(url)
    folder = folder.rstrip("/")
    return _find_in(system, folder, _list(system, folder))


def _find_below(system: Any, folder: str) -> Iterator[FoundScene]:
    listing = _list(system, folder)
    found = _find_in(system, folder, listing)
    yield from found
    if not any(len(scene.files.paths) > 1 for scene in found):
        for name in listing.folders:
            yield from _find_below(system, f"{folder}/{name}")


def _find_in(system: Any, folder: str, listing: _Listing) -> list[FoundScene]:
    if not listing.files:
        return []
    with temporary_folder() as top:
        local = place(top, folder)
        _imitate(system, folder, listing, local)
        found = list(find_in(str(local), list(listing.files)))
        base = str(system.unstrip_protocol(folder)).rstrip("/")
        return [scene._replace(files=_renamed(scene.files, local, base)) for scene in found]


def _imitate(system: Any, folder: str, listing: _Listing, local: Path) -> None:
    """Make a local folder with the heads of all files, and the names one folder below."""
    local.mkdir(parents=True, exist_ok=True)
    sizes = [(f"{folder}/{name}", size) for name, size in listing.files.items()]
    for name, head in zip(listing.files, read_heads(system, sizes), strict=True):
        (local / name).write_bytes(head)
    for inner in listing.folders:
        (local / inner).mkdir()
        for name in _list(system, f"{folder}/{inner}").files:
            (local / inner / name).touch()


def _renamed(files: SceneFiles, local: Path, base: str) -> SceneFiles:
    """Name the files of a scene by their URLs."""
    paths = [Path(path).relative_to(local).as_posix() for path in files.paths]
    return SceneFiles(files.name, tuple(f"{base}/{path}" for path in paths))


def _list(system: Any, folder: str) -> _Listing:
    """List a folder; hidden names, and those no local folder could have, are left out."""
    files, folders = {}, []
    for entry in system.ls(folder, detail=True):
        name = str(entry["name"]).rstrip("/").rsplit("/", 1)[-1]
        if name.startswith(".") or str(entry["name"]).rstrip("/") == folder:
            continue
        if entry["type"] == "directory":
            folders.append(name)
        else:
            files[name] = int(entry.get("size") or 0)
    return _Listing(dict(sorted(files.items())), sorted(folders))
