"""An export job: which rollouts, from which units, into which partial folder."""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from infgen.errors import ConfigError
from infgen.exports.wosac import About
from infgen.rollout.rollout import Rollout
from pipeline.engine import signals
from pipeline.engine.atomic import (
    MANIFEST,
    PARTIAL,
    StoreError,
    write_json,
)
from pipeline.engine.events import Event
from pipeline.engine.locks import locked
from pipeline.engine.manifest import read_manifest
from pipeline.storage.rollouts import read_lights
from pipeline.storage.scene_lookup import SceneLookup, unit_folders

REQUEST = "request.json"
_SAFE_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_VERSION = 2
"""Raised when the same rollouts would give other bytes."""


class ExportError(ValueError):
    """Rollouts that cannot be exported."""


@dataclass(frozen=True, slots=True)
class Order:
    """What is exported to where.

    Attributes:
        to: One of ``FORMATS``.
        rollouts: Folder of a stage or unit of rollouts.
        logs: The logs that they continue.
        out: File or folder to write.
        about: Description of a submission; None for other formats.
        scenes_per_shard: Of a submission.
    """

    to: str
    rollouts: Path
    logs: SceneLookup
    out: Path
    about: About | None = None
    scenes_per_shard: int = 300

    @property
    def partial(self) -> Path:
        """Folder of what is not finished yet."""
        return self.out.with_name(f"{self.out.name}{PARTIAL}")

    @property
    def lock(self) -> Path:
        """File that is held while it is written; gone when all is there."""
        out = self.out.absolute()
        return out.with_name(f"{out.name}.lock")

    def check_free(self) -> None:
        """Refuse to write where something stands.

        Raises:
            ConfigError: naming it.
        """
        if self.out.exists():
            raise ConfigError(f"{self.out} exists; remove it, or name another --out")


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        format: One of ``FORMATS``.
        out: File or folder.
        scenes: How many.
        rollouts: How many in all.
        files: How many in the folder, or shards in the submission.
        bytes: Of all files.
        before: Scenes that an earlier, killed run had written.
        filled: Agents without a model, at constant velocity, by scene; of a
            submission only.
        unused: Rollouts beyond those that a submission holds.
        not_simulated: Scenes that could not be simulated, with the reasons.
    """

    format: str
    out: str
    scenes: int
    rollouts: int
    files: int
    bytes: int
    before: int
    filled: Mapping[str, int]
    unused: int
    not_simulated: Sequence[str]

    def to_json(self) -> dict[str, Any]:
        """Everything, by name."""
        return asdict(self)


class Unit(NamedTuple):
    """A folder of rollouts, and which each of its scenes has, in order.

    Attributes:
        folder: Of the unit.
        scenes: Indices of the rollouts of each scene.
        lights: What lights showed after the history: ``now`` or ``log``.
    """

    folder: Path
    scenes: Mapping[str, Sequence[int]]
    lights: str

    @property
    def num_rollouts(self) -> int:
        """Rollouts of all its scenes."""
        return sum(map(len, self.scenes.values()))


class Part(NamedTuple):
    """All rollouts of one scene."""

    scenario_id: str
    rollouts: list[Rollout]


class Steps:
    """Reports how many scenes are done."""

    def __init__(self, tell: Callable[[Event], None], total: int) -> None:
        self._tell, self.total, self.done = tell, total, 0
        tell_export(tell, "progress", done=0, total=max(1, total), note="")

    def take(self, count: int = 1) -> None:
        """Count scenes as done. Here a request to stop arrives."""
        self.done += count
        tell_export(self._tell, "progress", done=self.done, total=self.total, note="")
        signals.raise_if_stopped()


def tell_export(tell: Callable[[Event], None], event: str, **more: Any) -> None:
    """Emit an event of the export."""
    tell({"event": event, "stage": "export", **more})


def find_units(rollouts: Path) -> list[Unit]:
    """List the units of a stage's folder, or a unit as its own, with their scenes.

    Raises:
        ConfigError: if the folder holds no rollouts.
        ExportError: if a scenario id cannot be part of a file name.
    """
    import polars as pl  # noqa: PLC0415

    found = []
    for folder in unit_folders(rollouts) or []:
        scenes: dict[str, list[int]] = {}
        index = pl.read_parquet(
            folder / "index.parquet", columns=["scenario_id", "rollout"]
        )
        for scenario_id, rollout in index.iter_rows():
            scenes.setdefault(scenario_id, []).append(rollout)
        found.append(Unit(folder, scenes, read_lights(folder)))
    for scenario_id in (each for unit in found for each in unit.scenes):
        if not _SAFE_ID.fullmatch(scenario_id):
            raise ExportError(f"scenario id {scenario_id!r} cannot name a file")
    if not any(unit.scenes for unit in found):
        raise ConfigError(f"{rollouts} holds no rollouts; `infgen rollout` makes some")
    return found


def parts_of(unit: Unit) -> Iterator[Part]:
    """Read a unit scene by scene.

    Raises:
        StoreError: if it does not hold what its index says.
    """
    from pipeline.storage.rollouts import read_rollouts  # noqa: PLC0415

    found = groupby(read_rollouts(unit.folder), key=lambda one: one.scenario_id)
    for name, wanted in unit.scenes.items():
        scenario_id, group = next(found, ("", iter(())))
        rollouts = list(group)
        if scenario_id != name or [one.index for one in rollouts] != list(wanted):
            raise StoreError(
                f"{unit.folder} does not hold the rollouts of scene {name} that its index "
                "names; `infgen verify` lists damage"
            )
        yield Part(name, rollouts)


def not_simulated(rollouts: Path) -> list[str]:
    """List the scenes that could not be simulated."""
    if not (rollouts / MANIFEST).is_file():
        return []
    return list(read_manifest(rollouts).get("report", {}).get("refused", []))


@contextmanager
def begin(order: Order, units: Sequence[Unit]) -> Iterator[None]:
    """Make the partial folder, empty unless an equal order left it, and hold it alone.

    Raises:
        ConfigError: if another process has just written ``out``.
        LockedError: if another process is at it.
    """
    with locked(order.lock):
        order.check_free()
        _clear(order, units)
        yield
        # A process that waited for the lock finds ``out``: the lock is no longer needed.
        order.lock.unlink()


def _clear(order: Order, units: Sequence[Unit]) -> None:
    """Make the partial folder, empty unless an equal order left it."""
    asked = {
        "version": _VERSION,
        "to": order.to,
        "rollouts": _identity(units),
        "about": asdict(order.about) if order.about else None,
        "scenes_per_shard": order.scenes_per_shard,
    }
    wanted = json.loads(json.dumps(asked))
    path = order.partial / REQUEST
    if path.is_file() and json.loads(path.read_text()) == wanted:
        return
    shutil.rmtree(order.partial, ignore_errors=True)
    order.partial.mkdir(parents=True)
    write_json(path, asked)


def _identity(units: Sequence[Unit]) -> str:
    """Identity of what some units hold: of their manifests, or else of their files."""
    digest = hashlib.sha256()
    for unit in units:
        manifest = unit.folder / MANIFEST
        digest.update(unit.folder.name.encode())
        if manifest.is_file():
            digest.update(manifest.read_bytes())
            continue
        for path in sorted(unit.folder.rglob("*")):
            about = path.stat()
            digest.update(f"{path.name} {about.st_size} {about.st_mtime_ns}".encode())
    return digest.hexdigest()
