"""Finding and removing artefacts that no stored request needs."""

import time
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.atomic import MANIFEST, PARTIAL, TRASH, StoreError, remove_folder
from pipeline.engine.layout import KEY_DIGITS, Root, read_json
from pipeline.engine.locks import locked
from pipeline.engine.manifest import read_manifest

PARTIAL_AGE_S = 24 * 3600.0
WEIGHTS_STAGE = "train"


@dataclass(frozen=True, slots=True)
class Garbage:
    """A folder that nothing needs.

    Attributes:
        path: The folder.
        bytes: Its size.
        why: What it holds.
    """

    path: Path
    bytes: int
    why: str


def find_garbage(root: Root, initial_weights: Collection[str] = ()) -> list[Garbage]:
    """List the folders that the latest stages of every profile do not need.

    Units of an unfinished stage are kept: the next run continues from them.

    Args:
        root: Of the experiment.
        initial_weights: Keys and folders of weights to keep too.
    """
    found = []
    for stage in root.stages():
        kept = _needed_names(root, stage, initial_weights)
        for folder in _folders(root, stage):
            if folder.name.endswith(PARTIAL):
                if folder.name.startswith(TRASH) or _age_s(folder) > PARTIAL_AGE_S:
                    found.append(Garbage(folder, _bytes(folder), "left by a killed run"))
            elif folder.name not in kept:
                what = "unit" if folder.parent.name == "units" else "stage"
                found.append(Garbage(folder, _bytes(folder), f"{what} of {stage}"))
    return found


def remove_garbage(root: Root, initial_weights: Collection[str] = ()) -> list[Garbage]:
    """Remove the garbage while holding the locks of all stages.

    Args:
        root: Of the experiment.
        initial_weights: Keys and folders of weights to keep too.

    Raises:
        LockedError: if a run is making one of them.
    """
    with ExitStack() as stack:
        for stage in root.stages():
            stack.enter_context(locked(root.lock(stage)))
        found = find_garbage(root, initial_weights)
        for garbage in found:
            remove_folder(garbage.path)
    return found


def _needed_names(root: Root, stage: str, initial_weights: Collection[str]) -> set[str]:
    """Names of folders that are needed, of the stage itself and of its units."""
    folders = {key[:KEY_DIGITS] for key in _remembered(root, stage)}
    latest_folder = root.latest_folder(stage)
    if latest_folder is not None:
        folders.add(latest_folder.name)
    if stage == WEIGHTS_STAGE:
        folders |= _named(root, initial_weights)
    units = set()
    for folder in folders:
        if (root.stage(stage) / folder / MANIFEST).is_file():
            manifest = read_manifest(root.stage(stage) / folder)
            units |= {unit["key"][:KEY_DIGITS] for unit in manifest["units"]}
    return folders | units | _unfinished_units(root, stage)


def _remembered(root: Root, stage: str) -> Iterator[str]:
    for request in (read_json(path) for path in sorted(root.refs.glob("*.json"))):
        key = request.get("keys", {}).get(stage)
        if key is not None:
            yield key


def _named(root: Root, initial_weights: Collection[str]) -> set[str]:
    """Return the names of the folders of weights that are given by key or path."""
    stage = root.stage(WEIGHTS_STAGE)
    found = set()
    for named in initial_weights:
        key = named[:KEY_DIGITS]
        found |= {path.name for path in stage.glob("*") if path.name.startswith(key)}
        place = Path(named).resolve()
        if place.is_relative_to(stage.resolve()):
            found.add(place.name)
    return found


def _unfinished_units(root: Root, stage: str) -> set[str]:
    try:
        attempt = read_json(root.attempt(stage))
    except StoreError:
        return set()
    return {key[:KEY_DIGITS] for key in attempt["units"].values()}


def _folders(root: Root, stage: str) -> Iterator[Path]:
    for parent in (root.stage(stage), root.units(stage)):
        for path in sorted(parent.glob("*")):
            if path.is_dir() and path != root.units(stage):
                yield path


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _age_s(folder: Path) -> float:
    newest = max(path.stat().st_mtime for path in (folder, *folder.rglob("*")))
    return time.time() - newest
