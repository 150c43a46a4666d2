"""Rollouts on disk: one Zarr group after the other, and an index of them."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import RolloutSettings
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.manifest import read_manifest
from pipeline.storage.parquet import Fields, make_table

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
"""Columns of ``index.parquet``."""


def write_rollouts(
    folder: Path, unit: str, groups: "Iterable[Sequence[Rollout]]"
) -> list[dict[str, Any]]:
    """Write rollouts as groups, and the index of them.

    Args:
        folder: Where to.
        unit: Its name in the index.
        groups: Rollouts, a group in memory at a time.

    Returns:
        The rows of the index.
    """
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from pipeline.storage.zarr_store import write_records  # noqa: PLC0415

    rows: list[dict[str, Any]] = []
    for group, rollouts in enumerate(groups):
        path = folder / f"rollouts-{group:03d}.zarr"
        write_records(path, rollouts, Rollout, ROLLOUTS_SCHEMA, compress=True)
        rows += [_row(unit, group, at, done) for at, done in enumerate(rollouts)]
    make_table(rows, INDEX).write_parquet(folder / "index.parquet")
    return rows


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


def _row(unit: str, group: int, at: int, rollout: "Rollout") -> dict[str, Any]:
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
