"""Files and folders below the root folder of an experiment.

::

    store/<stage>/<key>/         a finished stage: outputs of its ``finish``, manifest.json
    store/<stage>/units/<key>/   a finished unit: outputs of its ``work``, manifest.json
    store/<stage>/lock           held while the stage is being made
    store/<stage>/attempt.json   units of the last attempt, and which of them failed
    latest/<stage>, report       links to the folders of the last run
    refs/<profile>.json          the last request under a profile, and its keys
    logs/<time>-<pid>.jsonl      one line per event of a run
    cache/fingerprints.json      identities of source files
    cache/probe-<host>.json      what one unit of work takes on a machine

Folders carry the first 16 hexadecimal digits of their key.
"""

import json
import os
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.atomic import (
    MANIFEST,
    PARTIAL,
    StoreError,
    naming_refusals,
    sync_folder,
)

RUN = "run.json"
"""Beside the manifest: what differs from run to run ..."""
RUN_FOLDER = "run"
"""Folder of further files that differ from run to run; the manifest leaves them out."""
KEY_DIGITS = 16
STAGE_SCHEMA, UNIT_SCHEMA = "infgen.stage/2", "infgen.unit/2"
_OLD_SCHEMAS = ("infgen.stage/1", "infgen.unit/1", "infgen.comparison/1")


@dataclass(frozen=True, slots=True)
class Root:
    """The root folder of an experiment.

    Attributes:
        path: Absolute.
    """

    path: Path

    @property
    def store(self) -> Path:
        """Folder of all artefacts."""
        return self.path / "store"

    @property
    def latest(self) -> Path:
        """Folder of links to the artefacts of the last run."""
        return self.path / "latest"

    @property
    def logs(self) -> Path:
        """Folder of run logs."""
        return self.path / "logs"

    @property
    def refs(self) -> Path:
        """Folder of stored requests."""
        return self.path / "refs"

    @property
    def fingerprints(self) -> Path:
        """Cache of fingerprints of source files."""
        return self.path / "cache" / "fingerprints.json"

    def stage(self, stage: str) -> Path:
        """Folder of all artefacts of a stage."""
        return self.store / stage

    def folder(self, stage: str, key: str) -> Path:
        """Folder of a stage made under a key."""
        return self.stage(stage) / key[:KEY_DIGITS]

    def units(self, stage: str) -> Path:
        """Folder of a stage's units."""
        return self.stage(stage) / "units"

    def unit(self, stage: str, key: str) -> Path:
        """Folder of a unit."""
        return self.units(stage) / key[:KEY_DIGITS]

    def lock(self, stage: str) -> Path:
        """Lock file of a stage."""
        return self.stage(stage) / "lock"

    def attempt(self, stage: str) -> Path:
        """Record of a stage's last attempt."""
        return self.stage(stage) / "attempt.json"

    def is_finished(self, stage: str, key: str) -> bool:
        """Whether a stage is complete on disk."""
        return (self.folder(stage, key) / MANIFEST).is_file()

    def stages(self) -> list[str]:
        """Names of all stages that were ever begun in this root."""
        if not self.store.is_dir():
            return []
        return sorted(path.name for path in self.store.iterdir() if path.is_dir())

    def made(self) -> Iterator[tuple[str, Path]]:
        """Every complete folder of a stage or unit, as (stage, folder)."""
        for stage in self.stages():
            for parent in (self.stage(stage), self.units(stage)):
                for manifest in sorted(parent.glob(f"*/{MANIFEST}")):
                    if not manifest.parent.name.endswith(PARTIAL):
                        yield stage, manifest.parent

    def point(self, stage: str, key: str) -> None:
        """Make ``latest/<stage>`` (and ``report``) link to a finished folder."""
        folder = self.folder(stage, key)
        link(self.latest / stage, folder)
        if stage == "report":
            link(self.path / "report", folder)

    def latest_folder(self, stage: str) -> Path | None:
        """Return the folder that ``latest/<stage>`` links to, if it is complete."""
        folder = (self.latest / stage).resolve()
        return folder if (folder / MANIFEST).is_file() else None


def find_root(folder: Path, *, made: bool = False) -> Root:
    """Return the root at a folder that a command names.

    Args:
        folder: The folder.
        made: Whether it must hold artefacts: otherwise a misspelt root would look like an
            undamaged one.

    Raises:
        ConfigError: if it is a file; if nothing was made there, but must have been; or if
            an earlier version made it.
    """
    for place in (folder, *folder.absolute().parents):
        if place.exists() and not place.is_dir():
            own = "" if place == folder else f": {place}"
            raise ConfigError(f"--root {folder}{own} is a file; expected a folder")
    root = Root(folder.absolute())
    if made and not root.store.is_dir():
        what = "nothing was made there yet" if folder.exists() else "no such root"
        raise ConfigError(
            f"{folder}: {what}; expected the --root of a run (`infgen run --root {folder}` "
            "makes one)"
        )
    _refuse_old(root)
    return root


def _refuse_old(root: Root) -> None:
    """Refuse a root whose settings and columns have the names of an earlier version."""
    folder = next((folder for _, folder in root.made()), None)
    manifest = None
    if folder is not None:
        with suppress(StoreError):  # Commands name damage in their own words.
            manifest = read_json(folder / MANIFEST)
    schema = manifest.get("schema") if isinstance(manifest, dict) else None
    if schema in _OLD_SCHEMAS:
        raise ConfigError(
            f"--root {root.path} was made by an earlier version ({schema!r}, "
            f"expected {STAGE_SCHEMA!r}); remove {root.store} and `infgen run --root "
            f"{root.path}` makes it anew, or name another root"
        )


def link(name: Path, target: Path) -> None:
    """Make a relative link, or replace it, in one step.

    Raises:
        DiskError: if the file system refuses it.
        StoreError: if there is a file or folder of that name.
    """
    with naming_refusals(name):
        _link(name, target)


def _link(name: Path, target: Path) -> None:
    name.parent.mkdir(parents=True, exist_ok=True)
    relative = os.path.relpath(target, name.parent)
    if name.is_symlink() and os.readlink(name) == relative:
        return
    if name.exists() and not name.is_symlink():
        raise StoreError(f"{name} is in the way: expected a link; move it elsewhere")
    fresh = name.with_name(f"{name.name}.{uuid.uuid4().hex[:8]}{PARTIAL}")
    fresh.symlink_to(relative)
    fresh.replace(name)
    sync_folder(name.parent)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        StoreError: naming the file, if it is missing or damaged.
    """
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise StoreError(f"{path} is missing") from error
    except ValueError as error:
        raise StoreError(f"{path} is damaged: {error}") from error
