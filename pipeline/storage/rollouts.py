"""Rollouts on disk: one Zarr group after the other."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from infgen.config import RolloutSettings
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.manifest import read_manifest

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout

ROLLOUTS_SCHEMA = "infgen.rollouts/2"


def read_rollouts(folder: Path) -> "Iterator[Rollout]":
    """Read the rollouts of one unit, a group in memory at a time."""
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

    for path in sorted(folder.glob("rollouts-*.zarr")):
        yield from read_records(path, Rollout, ROLLOUTS_SCHEMA, whole=True)


def read_lights(folder: Path) -> str:
    """Tell what lights showed in a unit's rollouts: as it was then usual, if it is old."""
    if not (folder / MANIFEST).is_file():
        return RolloutSettings().signals
    played = read_manifest(folder).get("settings", {}).get("rollout", {})
    return str(played.get("signals", RolloutSettings().signals))
