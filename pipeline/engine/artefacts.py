"""Finding artefacts by the start of their keys, and comparing two of them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.engine.layout import RUN, Root, read_json
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import PlanError

LEAST_DIGITS = 4
PARTS = ("stage", "version", "settings", "inputs", "sources", "units", "report", "files")


def find(root: Root, key: str) -> Path:
    """Find the folder of a stage or unit by the start of its key, or by a stage's name.

    Raises:
        PlanError: if there is none, or more than one.
    """
    latest_folder = root.latest_folder(key)
    if latest_folder is not None:
        return latest_folder
    found = [folder for _, folder in root.made() if folder.name.startswith(key[:16])]
    if len(key) < LEAST_DIGITS or not found:
        raise PlanError(
            f"nothing made under {root.path} has a key that starts with {key!r}"
        )
    if len(found) > 1:
        names = ", ".join(folder.name for folder in found[:4])
        raise PlanError(
            f"{key!r} is the start of {len(found)} keys: {names}; give more digits"
        )
    return found[0]


def describe(folder: Path) -> dict[str, Any]:
    """Return manifest and run record of an artefact."""
    return {
        "folder": str(folder),
        **read_manifest(folder),
        "run": read_json(folder / RUN),
    }


def differences(one: Path, other: Path) -> Iterator[tuple[str, Any, Any]]:
    """List the differences of two artefacts, as (entry, value in one, in the other)."""
    first, second = read_manifest(one), read_manifest(other)
    for part in PARTS:
        yield from _differences(part, _named(first.get(part)), _named(second.get(part)))


def _named(value: Any) -> Any:
    """Turn a manifest's list of units into a mapping by name."""
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        return {unit["name"]: unit["key"][:16] for unit in value}
    return value


def _differences(what: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in sorted(one.keys() | other.keys()):
            yield from _differences(f"{what}.{name}", one.get(name), other.get(name))
    elif one != other:
        yield what, one, other
