"""Rollouts on disk: one Zarr group after the other."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout

ROLLOUTS_SCHEMA = "infgen.rollouts/2"


def read_rollouts(folder: Path) -> "Iterator[Rollout]":
    """Read the rollouts of one unit, a group in memory at a time."""
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

    for path in sorted(folder.glob("rollouts-*.zarr")):
        yield from read_records(path, Rollout, ROLLOUTS_SCHEMA, whole=True)
