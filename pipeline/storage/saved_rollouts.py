"""Rollouts of one scene in a folder of their own, together with the scene.

::

    rollouts-000.zarr, index.parquet      as a unit of stage ``rollout``
    scenes/scenes-000.zarr, index.parquet as a unit of stage ``ingest``
    manifest.json                         settings, and every file with its checksum

So commands that read units read this folder.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from infgen.errors import ConfigError
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.engine.atomic import MANIFEST, StoreError, publish, write_json
from pipeline.engine.manifest import list_files, read_manifest
from pipeline.storage.parquet import Fields, make_table
from pipeline.storage.rollouts import read_rollouts, write_rollouts
from pipeline.storage.scene_lookup import StoreLookup, saved_scenes
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.zarr_store import write_records

SCHEMA = "infgen.saved-rollouts/1"
GROUP_ROLLOUTS = 32
"""Rollouts of one group."""
_SCENES: Fields = {"scenario_id": str, "split": str, "group": str, "row": int}


class Saved(NamedTuple):
    """What a folder holds.

    Attributes:
        scene: The log.
        rollouts: In the order in which they were saved.
        settings: Of the rollouts, by name; empty for those of another simulator.
    """

    scene: Scene
    rollouts: tuple[Rollout, ...]
    settings: Mapping[str, Any]


def is_saved(folder: Path) -> bool:
    """Whether a folder holds rollouts together with their scene."""
    return (folder / MANIFEST).is_file() and saved_scenes(folder) is not None


def write_saved(
    folder: Path,
    scene: Scene,
    rollouts: Sequence[Rollout],
    settings: Mapping[str, Any],
    more: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write a folder, whole or not at all.

    Args:
        folder: Where to.
        scene: The log.
        rollouts: Its rollouts.
        settings: Of the rollouts, by name.
        more: What else the manifest says.

    Raises:
        ConfigError: if there is something already.
    """
    if folder.exists():
        raise ConfigError(f"{folder} exists; remove it, or name another folder")
    starts = range(0, len(rollouts), GROUP_ROLLOUTS)
    group = "scenes-000.zarr"
    with publish(folder) as partial:
        write_rollouts(
            partial,
            scene.scenario_id,
            (rollouts[at : at + GROUP_ROLLOUTS] for at in starts),
        )
        scenes = partial / "scenes"
        write_records(scenes / group, [scene], Scene, SCENES_SCHEMA, compress=True)
        row = dict(zip(_SCENES, (scene.scenario_id, "", group, 0), strict=True))
        make_table([row], _SCENES).write_parquet(scenes / "index.parquet")
        about = {**more, "schema": SCHEMA, "settings": {"rollout": dict(settings)}}
        write_json(partial / MANIFEST, {**about, "files": list_files(partial)})


def read_saved(folder: Path) -> Saved:
    """Read a folder.

    Raises:
        ConfigError: if it is none of these.
        StoreError: if it is damaged, or of another schema.
    """
    scenes = saved_scenes(folder)
    if scenes is None or not is_saved(folder):
        raise ConfigError(f"{folder} holds no saved rollouts; rollouts.save() writes them")
    manifest = read_manifest(folder)
    if manifest.get("schema") != SCHEMA:
        raise StoreError(
            f"{folder / MANIFEST} holds {manifest.get('schema')!r}, expected {SCHEMA!r}"
        )
    lookup = StoreLookup([scenes])
    (scenario_id,) = lookup.scenario_ids()
    return Saved(
        lookup.find(scenario_id),
        tuple(read_rollouts(folder)),
        manifest["settings"]["rollout"],
    )
