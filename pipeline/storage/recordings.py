"""Recorded drives on disk: a rollout, the log that it goes on from, and a manifest.

::

    NAME/rollouts-000.zarr   the rollout, as a unit of stage `rollout` has it
    NAME/index.parquet       its row
    NAME/scene/              the log, as a unit of stage `ingest` has it
    NAME/manifest.json       files with checksums, the settings, what it is of
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.errors import ConfigError
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.engine.atomic import MANIFEST, StoreError, publish
from pipeline.engine.manifest import Run, read_manifest, write_manifest
from pipeline.engine.plan import digest
from pipeline.storage.parquet import make_table
from pipeline.storage.rollouts import INDEX, ROLLOUTS_SCHEMA, index_row
from pipeline.storage.scenes import SCENES_SCHEMA

if TYPE_CHECKING:
    from infgen.config import RolloutSettings

RECORDING_SCHEMA = "infgen.recording/1"
SCENE = "scene"
"""Folder of the log within a recording."""
_SCENE_INDEX = {"scenario_id": str, "group": str, "row": int}


@dataclass(frozen=True, slots=True)
class About:
    """Where a recording is from.

    Attributes:
        source: Name of the file of records that holds its log.
        simulates: What the network did besides moving agents.
        settings: Settings that it was simulated with.
    """

    source: str
    simulates: str
    settings: "RolloutSettings"


def write_recording(target: Path, rollout: Rollout, scene: Scene, about: About) -> None:
    """Write a recording, whole or not at all.

    Raises:
        StoreError: if something is in its place.
    """
    from infgen.settings import key_values  # noqa: PLC0415
    from pipeline.storage.zarr_store import write_records  # noqa: PLC0415

    if target.exists():
        raise StoreError(f"{target} is in the way; expected a name that is free")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    with publish(target) as folder:
        write_records(
            folder / "rollouts-000.zarr", [rollout], Rollout, ROLLOUTS_SCHEMA, compress=True
        )
        row = index_row(target.name, 0, 0, rollout)
        make_table([row], INDEX).write_parquet(folder / "index.parquet")
        (folder / SCENE).mkdir()
        group = "scenes-000.zarr"
        write_records(folder / SCENE / group, [scene], Scene, SCENES_SCHEMA, compress=True)
        place = {"scenario_id": scene.scenario_id, "group": group, "row": 0}
        make_table([place], _SCENE_INDEX).write_parquet(folder / SCENE / "index.parquet")
        values = {
            "schema": RECORDING_SCHEMA,
            "scenario_id": rollout.scenario_id,
            "source": about.source,
            "simulates": about.simulates,
            "settings": {"rollout": key_values(about.settings)},
        }
        write_manifest(folder, values, Run(now, 0.0, {}))


def is_recording(folder: Path) -> bool:
    """Whether a folder holds a recorded drive."""
    with suppress(StoreError):
        return _schema(folder) == RECORDING_SCHEMA
    return False


def find_recordings(folder: Path, setting: str) -> list[Path]:
    """Find the recordings in a folder, or the one that it is, by name.

    Raises:
        ConfigError: if there is none.
    """
    if is_recording(folder):
        return [folder]
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    found = [path for path in inside if is_recording(path)]
    if not found:
        raise ConfigError(
            f"{setting} is {str(folder)!r}, which holds no recorded drive; expected a "
            "folder that `infgen drive` saved, or one of several"
        )
    return found


def read_about(folder: Path) -> Mapping[str, Any]:
    """Read the manifest of a recording.

    Raises:
        StoreError: if it is damaged.
    """
    return read_manifest(folder)


def fingerprint(folder: Path) -> str:
    """Return the identity of what a recording holds."""
    return digest(read_about(folder)["files"])


def _schema(folder: Path) -> object:
    if not (folder / MANIFEST).is_file():
        return None
    return read_about(folder).get("schema")
