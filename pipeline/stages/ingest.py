"""Ingest: raw records -> scenes in Zarr, an index of them, and a quarantine of the rest.

One unit per TFRecord, or per group of scene files
(``pipeline.storage.sources.scene_groups``). Memory stays bounded whatever the file holds:
scenes are written in groups of bounded size as they come. A record that cannot be used is a
named row of ``quarantine.parquet``; it never stops the file, and the file never stops the
stage.
"""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from infgen.config import IngestSettings
from infgen.scene import Scene
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.stages.ingest_records import Ingested, iter_ingested
from pipeline.storage.duplicates import mark_duplicates, report_duplicates
from pipeline.storage.parquet import make_table, read_tables
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.sources.changes import check_unchanged
from pipeline.storage.splits import split_of

if TYPE_CHECKING:
    import polars as pl

GROUP_BYTES = 96 << 20
"""Columns of one group in memory; a worker holds about three times as much."""

_INDEX = {
    "scenario_id": str,
    "split": str,
    "group": str,
    "row": int,
    "source": str,
    "file": str,
    "dataset": str,
    "annotation_hz": float,
    "record": int,
    "offset": int,
    "record_bytes": int,
    "agents": int,
    "steps": int,
    "features": int,
    "points": int,
    "signals": int,
}
_QUARANTINE = {"source": str, "record": int, "offset": int, "reason": str}
_DUPLICATES = {**_QUARANTINE, "scenario_id": str, "first_source": str, "first_record": int}
_MARKED = ("scenario_id", "split", "duplicate", "source", "record", "offset")


def plan(inputs: Inputs, settings: IngestSettings) -> Sequence[Unit]:
    """One unit per source file, or group of them."""
    return [
        Unit(
            source.name,
            {"source": source.fingerprint},
            {"scenes": source.parts} if source.parts else {"url": source.url},
        )
        for source in inputs.sources
    ]


def work(unit: Unit, target: Path, settings: IngestSettings, progress: Progress) -> Report:
    """Ingest one file or group.

    Raises:
        ChangedSourceError: if it was replaced while it was read.
    """
    target.mkdir(parents=True, exist_ok=True)
    shard = _Shard(target, unit.name, settings.max_scenes_per_shard)
    for record in iter_ingested(unit.name, unit.task, settings.now_step):
        shard.take(record)
        if (
            settings.max_scenes_per_file
            and len(shard.index) >= settings.max_scenes_per_file
        ):
            break
    shard.close()
    check_unchanged(unit.name, unit.task, unit.inputs["source"])
    return shard.report()


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: IngestSettings,
    progress: Progress,
) -> Report:
    """Join the units' tables, and name scenes that several files hold.

    All are listed in ``duplicates.parquet``; those marked in the index do not count.
    """
    target.mkdir(parents=True, exist_ok=True)
    paths = [unit.path for unit in units]
    index = mark_duplicates(read_tables(paths, "index.parquet", _INDEX))
    quarantine = read_tables(paths, "quarantine.parquet", _QUARANTINE)
    duplicates = _duplicates(index)
    index.write_parquet(target / "index.parquet")
    quarantine.write_parquet(target / "quarantine.parquet")
    duplicates.write_parquet(target / "duplicates.parquet")
    duplicate_rows = report_duplicates(index)
    return {
        "scenes": len(index),
        "quarantined": len(quarantine),
        "duplicates": int(index["duplicate"].sum()),
        **({"units": duplicate_rows} if duplicate_rows else {}),
    }


class _Shard:
    """The scenes of one file on their way to disk."""

    def __init__(self, target: Path, source: str, max_scenes: int) -> None:
        self.index: list[dict[str, Any]] = []
        self._target, self._source, self._max_scenes = target, source, max_scenes
        self._bad: list[dict[str, Any]] = []
        self._pending: list[Scene] = []
        self._pending_bytes = self._record_bytes = self._groups = 0
        self._records: dict[str, int] = {}

    def take(self, record: Ingested) -> None:
        """Keep one record as a scene, or as a row of the quarantine."""
        found = record.found
        self._record_bytes += record.num_bytes
        if isinstance(found, Scene) and found.scenario_id in self._records:
            first = self._records[found.scenario_id]
            found = f"duplicate id {found.scenario_id}: record {first} has it already"
        if isinstance(found, Scene):
            self._keep(record, found)
        else:
            reason = found if record.file == self._source else f"{record.file}: {found}"
            row = (self._source, record.number, record.offset, reason)
            self._bad.append(dict(zip(_QUARANTINE, row, strict=True)))

    def close(self) -> None:
        """Write what is left, and the tables."""
        self._flush()
        make_table(self.index, _INDEX).write_parquet(self._target / "index.parquet")
        make_table(self._bad, _QUARANTINE).write_parquet(
            self._target / "quarantine.parquet"
        )

    def report(self) -> Report:
        """Sum up the unit."""
        files = [path for path in self._target.rglob("*") if path.is_file()]
        return {
            "split": split_of(self._source),
            "scenes": len(self.index),
            "quarantined": len(self._bad),
            "record_bytes": self._record_bytes,
            "disk_bytes": sum(path.stat().st_size for path in files),
        }

    def _keep(self, record: Ingested, scene: Scene) -> None:
        self._records[scene.scenario_id] = record.number
        row = {
            "scenario_id": scene.scenario_id,
            "split": split_of(self._source),
            "group": self._group_name,
            "row": len(self._pending),
            "source": self._source,
            "file": record.file,
            "dataset": record.dataset,
            "annotation_hz": record.annotation_hz,
            "record": record.number,
            "offset": record.offset,
            "record_bytes": record.num_bytes,
            "agents": scene.tracks.num_agents,
            "steps": scene.tracks.num_steps,
            "features": scene.road_map.num_features,
            "points": len(scene.road_map.xyz_m),
            "signals": len(scene.signals.step),
        }
        self.index.append(row)
        self._pending.append(scene)
        self._pending_bytes += num_bytes(scene)
        if len(self._pending) >= self._max_scenes or self._pending_bytes >= GROUP_BYTES:
            self._flush()

    @property
    def _group_name(self) -> str:
        return f"scenes-{self._groups:03d}.zarr"

    def _flush(self) -> None:
        from pipeline.storage.zarr_store import write_records  # noqa: PLC0415

        if not self._pending:
            return
        path = self._target / self._group_name
        write_records(path, self._pending, Scene, SCENES_SCHEMA, compress=True)
        self._pending, self._pending_bytes = [], 0
        self._groups += 1


def num_bytes(record: Any) -> int:
    """Count the bytes of all arrays of a record."""
    total = 0
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif is_dataclass(value):
            total += num_bytes(value)
    return total


def _duplicates(index: "pl.DataFrame") -> "pl.DataFrame":
    """Name the scenes that an earlier file holds too, of their split or of another."""
    import polars as pl  # noqa: PLC0415

    several = index.filter(pl.col("scenario_id").is_duplicated()).select(_MARKED)
    first: dict[tuple[str, ...], tuple[str, int]] = {}
    rows = []
    for name, split, duplicate_rows, source, record, offset in several.iter_rows():
        place = (source, record)
        in_split = first.setdefault((name, split), place)
        earlier = first.setdefault((name,), place)
        if duplicate_rows:
            earlier, fate = in_split, "left out"
        elif earlier != place:
            fate = "both count"
        else:
            continue
        reason = f"scenario {name} is in {earlier[0]} too: {fate}"
        rows.append((*place, offset, reason, name, *earlier))
    return make_table(
        [dict(zip(_DUPLICATES, row, strict=True)) for row in rows], _DUPLICATES
    )


STAGE = Stage(
    name="ingest",
    version=3,
    settings={"ingest": IngestSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "pipeline.storage.columns",
        "pipeline.storage.duplicates",
        "pipeline.stages.ingest",
        "pipeline.stages.ingest_records",
        "pipeline.storage.parquet",
        "pipeline.storage.sources.scene_groups",
        "pipeline.storage.splits",
        "pipeline.storage.zarr_store",
    ),
)
