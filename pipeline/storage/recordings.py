"""Recorded drives on disk: saved rollouts, and where they are from.

A recording is a folder of ``saved_rollouts`` whose manifest also says ``drive``.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.errors import ConfigError
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene
from pipeline.engine.atomic import StoreError
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import digest
from pipeline.storage.saved_rollouts import is_saved, write_saved

if TYPE_CHECKING:
    from infgen.config import RolloutSettings

DRIVE = "drive"


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
        ConfigError: if there is something in its place.
    """
    from infgen.settings import key_values  # noqa: PLC0415

    drive = {
        "source": about.source,
        "simulates": about.simulates,
        "rules": about.settings.rules_in_words,
    }
    write_saved(target, scene, [rollout], key_values(about.settings), {DRIVE: drive})


def is_recording(folder: Path) -> bool:
    """Whether a folder holds a recorded drive."""
    with suppress(StoreError):
        return is_saved(folder) and DRIVE in read_about(folder)
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
