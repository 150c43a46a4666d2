"""Tables of scores: written unit by unit, joined without reading all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.score.summary import Tally, mean_curves

SCHEMA = {
    "scenario_id": pl.String,
    "rollout": pl.Int32,
    "metric": pl.String,
    "value": pl.Float64,
}
CURVE_SCHEMA = {
    "metric": pl.String,
    "window": pl.Int32,
    "value": pl.Float64,
    "rollouts": pl.Int64,
}
MEAN_SCHEMA = {"scenario_id": pl.String, "metric": pl.String, "value": pl.Float64}
SUM_SCHEMA = {**CURVE_SCHEMA, "rollouts": pl.Float64}
ROWS, SCENES, SUMS = "rows.parquet", "scenes.parquet", "sums.parquet"


class ScoreRow(NamedTuple):
    """One number of one rollout, or of a scene as a whole (``rollout`` None)."""

    scenario_id: str
    rollout: int | None
    metric: str
    value: float


def rows_of(
    scenario_id: str, rollout: int | None, numbers: Mapping[str, float], prefix: str
) -> list[ScoreRow]:
    """One row per number."""
    return [
        ScoreRow(scenario_id, rollout, f"{prefix}{name}", value)
        for name, value in numbers.items()
    ]


def write_part(path: Path, rows: Sequence[ScoreRow]) -> None:
    """Write the rows of one unit; a metric without a value has no row."""
    known = [row for row in rows if not np.isnan(row.value)]
    pl.DataFrame(known, schema=SCHEMA, orient="row").write_parquet(path)


def join_parts(parts: Sequence[Path], target: Path) -> None:
    """Join parts in their order."""
    if not parts:
        pl.DataFrame(schema=SCHEMA).write_parquet(target)
        return
    pl.scan_parquet(list(parts)).sink_parquet(target, maintain_order=True)


def write_tally(folder: Path, tally: Tally) -> None:
    """Write the means of each scene and the sums of each window.

    All scenes have the same metrics, in the same order.
    """
    scenes = [
        (scene, name, value)
        for scene, means in tally.means.items()
        for name, value in means.items()
    ]
    schema = MEAN_SCHEMA
    pl.DataFrame(scenes, schema=schema, orient="row").write_parquet(folder / SCENES)
    write_sums(folder / SUMS, tally.sums)


def write_sums(target: Path, sums: Mapping[str, np.ndarray]) -> None:
    """Write sums [value or count, window] by metric."""
    rows = [
        (metric, window, float(total), float(count))
        for metric, values in sums.items()
        for window, (total, count) in enumerate(values.T)
    ]
    pl.DataFrame(rows, schema=SUM_SCHEMA, orient="row").write_parquet(target)


def write_curves(target: Path, sums: Mapping[str, np.ndarray]) -> None:
    """Write the mean over rollouts of every metric in every window."""
    rows = [
        (metric, window, float(value), int(count))
        for metric, curve in mean_curves(sums).items()
        for window, (value, count) in enumerate(zip(*curve, strict=True))
        if count
    ]
    pl.DataFrame(rows, schema=CURVE_SCHEMA, orient="row").write_parquet(target)
