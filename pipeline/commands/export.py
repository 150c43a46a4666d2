"""``infgen export``: rollouts in the formats of others, a scene in memory at a time.

What is being written stands under ``OUT.partial`` and gets its name when all is there. A
run that was killed goes on from what it had finished (a scene; for a submission a shard),
if the same is asked for again.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from infgen.config import ConfigError, RolloutSettings
from infgen.exports import gpudrive, scenarionet
from infgen.exports.rows import rows_of
from infgen.exports.wosac import About
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.engine import signals
from pipeline.engine.atomic import PARTIAL, StoreError, publish, write_file, write_json
from pipeline.engine.events import Event
from pipeline.engine.layout import MANIFEST
from pipeline.engine.locks import locked
from pipeline.engine.manifest import read_manifest
from pipeline.storage.scene_lookup import Logs, unit_folders

WOSAC = "wosac"
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
        about: Who submits what; of a submission only.
        scenes_per_shard: Of a submission.
    """

    to: str
    rollouts: Path
    logs: Logs
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
        filled: Agents that no model plays and that keep their velocity, by scene; of a
            submission only.
        unused: Rollouts beyond those that a submission holds.
        not_played: What the stage of the rollouts could not play, with the reasons.
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
    not_played: Sequence[str]

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


class Form(NamedTuple):
    """How one scene is written.

    Attributes:
        name: File of a rollout, by scenario id and index.
        write: Writes the files of some rollouts of a scene below a folder, told what lights
            showed while they were played.
    """

    name: Callable[[str, int], str]
    write: Callable[[Path, Scene, Sequence[Rollout], str], None]


def export(order: Order, tell: Callable[[Event], None] = lambda _: None) -> Exported:
    """Write all rollouts of an order.

    Raises:
        ConfigError: if the format is unknown, ``out`` exists, or there are no rollouts.
        ExportError: if an id cannot name a file.
        RolloutsError: if a scene of a submission is not as it must be.
        LockedError: if another process writes there.
    """
    from pipeline.commands.export_wosac import export_submission  # noqa: PLC0415

    if order.to not in FORMATS:
        near = get_close_matches(order.to, FORMATS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(FORMATS)}"
        raise ConfigError(f"no format {order.to!r}; {hint}")
    order.check_free()
    units = find_units(order.rollouts)
    _say(tell, "work-started", units=1, made=0, what="scenes")
    write = export_submission if order.to == WOSAC else _export_folder
    return write(order, units, Steps(tell, sum(len(unit.scenes) for unit in units)))


class Steps:
    """Tells how many scenes are done."""

    def __init__(self, tell: Callable[[Event], None], total: int) -> None:
        self._tell, self.total, self.done = tell, total, 0
        _say(tell, "progress", done=0, total=max(1, total), note="")

    def take(self, count: int = 1) -> None:
        """Count scenes as done. Here a request to stop arrives."""
        self.done += count
        _say(self._tell, "progress", done=self.done, total=self.total, note="")
        signals.check()


def _say(tell: Callable[[Event], None], event: str, **more: Any) -> None:
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
        found.append(Unit(folder, scenes, _lights_of(folder)))
    for scenario_id in (each for unit in found for each in unit.scenes):
        if not _SAFE_ID.fullmatch(scenario_id):
            raise ExportError(f"scenario id {scenario_id!r} cannot name a file")
    if not any(unit.scenes for unit in found):
        raise ConfigError(f"{rollouts} holds no rollouts; `infgen rollout` plays some")
    return found


def _lights_of(folder: Path) -> str:
    """Tell what lights showed in a unit's rollouts: as it was then usual, if it is old."""
    if not (folder / MANIFEST).is_file():
        return RolloutSettings().lights
    played = read_manifest(folder).get("settings", {}).get("rollout", {})
    return str(played.get("lights", RolloutSettings().lights))


def parts_of(unit: Unit) -> Iterator[Part]:
    """Read a unit scene by scene.

    Raises:
        StoreError: if it does not hold what its index says.
    """
    from pipeline.stages.rollout import read_rollouts  # noqa: PLC0415

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


def not_played(rollouts: Path) -> list[str]:
    """Say what the stage of some rollouts could not play."""
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
        # Who has waited for it finds that ``out`` is there, so nobody needs it any more.
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


def _export_folder(order: Order, units: Sequence[Unit], steps: Steps) -> Exported:
    """Write a folder of files, a scene at a time, those that are there already left out."""
    form, before = _FOLDERS[order.to], 0
    with begin(order, units), publish(order.out, resume=True) as folder:
        for unit in units:
            made = {name for name in unit.scenes if _is_there(form, folder, unit, name)}
            before += len(made)
            steps.take(len(made))
            for part in parts_of(unit) if len(made) < len(unit.scenes) else ():
                if part.scenario_id not in made:
                    scene = order.logs.find(part.scenario_id)
                    form.write(folder, scene, part.rollouts, unit.lights)
                    steps.take()
        (folder / REQUEST).unlink()
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in files)
    return Exported(
        format=order.to,
        out=str(order.out),
        scenes=steps.total,
        rollouts=sum(unit.num_rollouts for unit in units),
        files=len(files),
        bytes=size,
        before=before,
        filled={},
        unused=0,
        not_played=not_played(order.rollouts),
    )


def _is_there(form: Form, folder: Path, unit: Unit, scenario_id: str) -> bool:
    """Whether all files of a scene are written; each is written whole."""
    rollouts = unit.scenes[scenario_id]
    return all((folder / form.name(scenario_id, one)).is_file() for one in rollouts)


def _gpudrive_name(scenario_id: str, rollout: int) -> str:
    """Name a file as GPUDrive's loader looks for it."""
    return f"tfrecord-{scenario_id}_{rollout:03d}.json"


def _scenarionet_name(scenario_id: str, rollout: int) -> str:
    """Name a file as ScenarioNet does, but for its ending."""
    return f"sd_{scenarionet.DATASET}_{scenario_id}_{rollout:03d}.json"


def _json_form(
    file_name: Callable[[str, int], str],
    map_text: Callable[[Scene], str],
    scene_text: Callable[[Rollout, Scene, str, str, str], str],
) -> Form:
    """Write a file per rollout, the map made once for all of a scene."""

    def write(folder: Path, scene: Scene, rollouts: Sequence[Rollout], lights: str) -> None:
        roads = map_text(scene)
        for one in rollouts:
            name = f"{one.scenario_id}_{one.index:03d}"
            text = scene_text(one, scene, name, roads, lights)
            write_file(folder / file_name(one.scenario_id, one.index), text.encode())

    return Form(file_name, write)


def _parquet_name(scenario_id: str, rollout: int) -> str:
    """One partition and one file per scene, under the name that readers of Parquet know."""
    return f"scenario_id={scenario_id}/rollouts.parquet"


def _write_parquet(
    folder: Path, scene: Scene, rollouts: Sequence[Rollout], lights: str
) -> None:
    import polars as pl  # noqa: PLC0415

    path = folder / _parquet_name(scene.scenario_id, 0)
    path.parent.mkdir(exist_ok=True)
    partial = path.with_name(f"{path.name}{PARTIAL}")
    rows = dict(rows_of(rollouts, scene))
    pl.DataFrame(rows).write_parquet(partial, compression="zstd")
    partial.replace(path)


_FOLDERS = {
    "gpudrive": _json_form(_gpudrive_name, gpudrive.map_text, gpudrive.scene_text),
    "scenarionet": _json_form(
        _scenarionet_name, scenarionet.map_text, scenarionet.scene_text
    ),
    "parquet": Form(_parquet_name, _write_parquet),
}
FORMATS = (WOSAC, *_FOLDERS)
