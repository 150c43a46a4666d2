"""``infgen export``: rollouts in the formats of others, a scene in memory at a time.

What is being written stands under ``OUT.partial`` and gets its name when all is there. A
run that was killed goes on from what it had finished (a scene; for a submission a shard),
if the same export is requested again.
"""

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from infgen.errors import ConfigError
from infgen.exports import gpudrive, scenarionet
from infgen.exports.rows import rows_of
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.commands.export_job import (
    REQUEST,
    Exported,
    Order,
    Steps,
    Unit,
    begin,
    find_units,
    not_simulated,
    parts_of,
    tell_export,
)
from pipeline.commands.export_wosac import export_submission
from pipeline.engine.atomic import (
    PARTIAL,
    publish,
    write_file,
)
from pipeline.engine.events import Event

WOSAC = "wosac"


class Form(NamedTuple):
    """How one scene is written.

    Attributes:
        name: File of a rollout, by scenario id and index.
        write: Writes the files of some rollouts of a scene below a folder, with the signals
            that showed while they were simulated.
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
    if order.to not in FORMATS:
        near = get_close_matches(order.to, FORMATS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(FORMATS)}"
        raise ConfigError(f"no format {order.to!r}; {hint}")
    order.check_free()
    units = find_units(order.rollouts)
    tell_export(tell, "work-started", units=1, made=0, what="scenes")
    write = export_submission if order.to == WOSAC else _export_folder
    return write(order, units, Steps(tell, sum(len(unit.scenes) for unit in units)))


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
        not_simulated=not_simulated(order.rollouts),
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
