"""Manifests: how a folder was made, and every file in it with its checksum.

``manifest.json`` is the same in every run of the same work. Times and the machine are in
``run.json`` beside it.
"""

import platform
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import google_crc32c

from pipeline.engine import machine
from pipeline.engine.atomic import MANIFEST, StoreError, write_json
from pipeline.engine.layout import RUN, RUN_FOLDER, Root, read_json
from pipeline.engine.stage import Report

BLOCK_BYTES = 1 << 22
PACKAGES = ("infgen", "numpy", "polars", "torch", "zarr")
"""Packages whose versions are recorded, as they may change the bytes."""


@dataclass(frozen=True, slots=True)
class Run:
    """When and where a folder was made, and the part of its report that varies."""

    started: str
    seconds: float
    varying: Mapping[str, Any]

    def write(self, folder: Path) -> None:
        """Write ``run.json``."""
        about = {
            "host": socket.gethostname(),
            "machine": machine.describe(),
            "started": self.started,
            "seconds": round(self.seconds, 3),
            "report": dict(self.varying),
        }
        write_json(folder / RUN, about)


def split_report(report: Report) -> tuple[Report, Report]:
    """Split a report into its reproducible part and the part under ``run``."""
    same = {name: value for name, value in sorted(report.items()) if name != "run"}
    return same, dict(report.get("run", {}))


def write_manifest(folder: Path, about: Mapping[str, Any], run: Run) -> None:
    """Write ``run.json`` and, as the very last file, ``manifest.json``."""
    run.write(folder)
    write_json(folder / MANIFEST, {**about, "files": list_files(folder)})


def list_files(folder: Path) -> dict[str, list[Any]]:
    """List every file below a folder as ``{path: [bytes, crc32c]}``."""
    return {
        str(path.relative_to(folder)): [path.stat().st_size, crc32c(path)]
        for path in _files(folder)
    }


def _files(folder: Path) -> Iterator[Path]:
    apart = {folder / MANIFEST, folder / RUN}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path not in apart and folder / RUN_FOLDER not in path.parents:
            yield path


def crc32c(path: Path) -> str:
    """Checksum of a file, read in blocks."""
    checksum = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            checksum = google_crc32c.extend(checksum, block)
    return f"{checksum:08x}"


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a made folder.

    Raises:
        StoreError: if it is missing or damaged.
    """
    try:
        manifest = read_json(folder / MANIFEST)
    except StoreError as error:
        raise StoreError(f"{error}{_remedy(folder)}") from error
    if not isinstance(manifest, dict) or "files" not in manifest:
        path = folder / MANIFEST
        raise StoreError(f"{path} is damaged: it lists no files{_remedy(folder)}")
    return manifest


def _remedy(folder: Path) -> str:
    """Name the command that makes a damaged stage or unit again, if there is one."""
    stage = folder.resolve().parent
    stage = stage.parent if stage.name == "units" else stage
    root = Root(stage.parent.parent)
    if stage.parent != root.store:
        return ""
    return f"; `infgen run {stage.name} --root {root.path} --force` makes it again"


def verify(root: Root, *, full: bool) -> Iterator[str]:
    """Find damaged, missing and unexpected files below a root.

    Args:
        root: Of the experiment.
        full: Whether to compare checksums too, not only sizes.

    Yields:
        One line per file, and per missing unit.
    """
    for stage, folder in root.made():
        try:
            manifest = read_manifest(folder)
        except StoreError as error:
            yield str(error)
            continue
        way = _remedy(folder)
        for line in _damage(folder, manifest["files"], full=full):
            yield f"{line}{way}"
        for unit in manifest.get("units", []):
            place = root.unit(stage, unit["key"])
            if not (place / MANIFEST).is_file():
                yield f"{place} is missing (unit {unit['name']}){way}"


def _damage(
    folder: Path, files: Mapping[str, Sequence[Any]], *, full: bool
) -> Iterator[str]:
    for name, (size, crc) in files.items():
        path = folder / name
        if not path.is_file():
            yield f"{path} is missing"
        elif path.stat().st_size != size:
            yield f"{path} holds {path.stat().st_size} bytes, expected {size}"
        elif full and (found := crc32c(path)) != crc:
            yield f"{path} has checksum {found}, expected {crc}"
    for path in _files(folder):
        if str(path.relative_to(folder)) not in files:
            yield f"{path} is not in the manifest"


@cache
def package_versions() -> Mapping[str, str]:
    """Versions of Python and of the packages that may change the bytes."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "absent"
    return versions
