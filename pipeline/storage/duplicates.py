"""Duplicate scenes: of scenes that several files of a split hold, the first file counts.

All stages that read scenes skip the duplicates, which would otherwise be trained on,
simulated and scored twice.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.engine.stage import FinishedUnit, Report

if TYPE_CHECKING:
    import polars as pl

    from infgen.scene import Scene

DUPLICATE_ROWS = "duplicate_rows"
"""Ranges ``[first, after)`` of rows of a file's scenes that are duplicates: an entry in the
report of stage ``ingest`` on the file, and in the tasks of stages that read it."""


def mark_duplicates(index: "pl.DataFrame") -> "pl.DataFrame":
    """Mark duplicate scenes in an index of all files, ordered by name."""
    import polars as pl  # noqa: PLC0415

    first = pl.struct("split", "scenario_id").is_first_distinct()
    return index.with_columns(duplicate=~first)


def report_duplicates(index: "pl.DataFrame") -> dict[str, Report]:
    """Return the rows of marked scenes of each file that has any."""
    import polars as pl  # noqa: PLC0415

    rows = index.select("source", "duplicate", at=pl.int_range(pl.len()).over("source"))
    parts = rows.filter("duplicate").partition_by("source", maintain_order=True)
    return {
        part["source"][0]: {DUPLICATE_ROWS: _ranges(part["at"].to_numpy())}
        for part in parts
    }


def unique_rows(file: FinishedUnit) -> list[int]:
    """Rows of the scenes of an ingested file that are no duplicates."""
    duplicate_rows = _rows(file.report)
    return [row for row in range(int(file.report["scenes"])) if row not in duplicate_rows]


def scenes_task(file: FinishedUnit) -> dict[str, Any]:
    """Describe the unique scenes of an ingested file for the task of a unit."""
    duplicate_rows = file.report.get(DUPLICATE_ROWS)
    return {
        "scenes": str(file.path),
        **({DUPLICATE_ROWS: duplicate_rows} if duplicate_rows else {}),
    }


def read_task_scenes(task: Mapping[str, Any]) -> "Iterator[Scene]":
    """Stream the scenes that a task names.

    Raises:
        StoreError: if a group of them is damaged.
    """
    from pipeline.storage.scenes import read_scenes  # noqa: PLC0415

    duplicate_rows = _rows(task)
    scenes = enumerate(read_scenes(Path(task["scenes"])))
    return (scene for row, scene in scenes if row not in duplicate_rows)


def _rows(about: Mapping[str, Any]) -> set[int]:
    return {
        row for first, after in about.get(DUPLICATE_ROWS, ()) for row in range(first, after)
    }


def _ranges(rows: np.ndarray) -> list[list[int]]:
    """Write ascending rows as ranges."""
    parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [[int(part[0]), int(part[-1]) + 1] for part in parts]
