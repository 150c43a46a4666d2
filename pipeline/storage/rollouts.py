"""Rollouts on disk: one Zarr group after the other."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.storage.parquet import Fields

if TYPE_CHECKING:
    from infgen.rollout.rollout import Rollout

ROLLOUTS_SCHEMA = "infgen.rollouts/2"
INDEX: Fields = {
    "scenario_id": str,
    "rollout": int,
    "unit": str,
    "group": int,
    "row": int,
    "agents": int,
    "inserted": int,
    "left": int,
    "steps": int,
}
"""Columns of the index of rollouts."""


def read_rollouts(folder: Path) -> "Iterator[Rollout]":
    """Read the rollouts of one unit, a group in memory at a time."""
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

    for path in sorted(folder.glob("rollouts-*.zarr")):
        yield from read_records(path, Rollout, ROLLOUTS_SCHEMA, whole=True)


def index_row(unit: str, group: int, at: int, rollout: "Rollout") -> dict[str, Any]:
    """Return the row of the index that tells of a rollout.

    Args:
        unit: Name of its unit.
        group: Number of the Zarr group that holds it.
        at: Its place there.
        rollout: The rollout.
    """
    return {
        "scenario_id": rollout.scenario_id,
        "rollout": rollout.index,
        "unit": unit,
        "group": group,
        "row": at,
        "agents": len(rollout.id),
        "inserted": int((~rollout.logged).sum()),
        "left": int((rollout.exit_step >= 0).sum()),
        "steps": rollout.num_steps,
    }
