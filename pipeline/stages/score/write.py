"""Tables of scores: written unit by unit, joined without reading all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.score.summary import Tally

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
    empty = pl.LazyFrame(schema=SCHEMA)
    frames = [pl.scan_parquet(path) for path in parts]
    pl.concat([empty, *frames]).sink_parquet(target, maintain_order=True)


def write_tally(folder: Path, tally: Tally) -> None:
    """Write the means of each scene (a column per metric) and the sums of each window."""
    names = tally.names()
    schema = {"scenario_id": pl.String, **dict.fromkeys(names, pl.Float64)}
    scenes = [
        (scene, *(means[name] for name in names)) for scene, means in tally.means.items()
    ]
    pl.DataFrame(scenes, schema=schema, orient="row").write_parquet(folder / SCENES)
    sums = [
        (metric, window, float(total), float(count))
        for metric, values in tally.sums.items()
        for window, (total, count) in enumerate(values.T)
    ]
    pl.DataFrame(sums, schema=SUM_SCHEMA, orient="row").write_parquet(folder / SUMS)


def read_tally(folder: Path, rollouts: int) -> Tally:
    """Read what one unit has tallied of so many rollouts."""
    scenes = pl.read_parquet(folder / SCENES)
    return Tally(
        means={row.pop("scenario_id"): row for row in scenes.iter_rows(named=True)},
        rollouts=rollouts,
        sums=read_sums(folder / SUMS),
    )


def read_sums(path: Path) -> dict[str, np.ndarray]:
    """Read sums [value or count, window] by metric; the rows of a metric lie together."""
    table = pl.read_parquet(path)
    values = table.select("value", "rollouts").to_numpy().T
    metrics = table["metric"]
    starts = np.flatnonzero((metrics != metrics.shift()).fill_null(value=True).to_numpy())
    parts = np.split(values, starts[1:], axis=1) if len(starts) else []
    return dict(zip(metrics.gather(starts).to_list(), parts, strict=True))


def write_curves(target: Path, tally: Tally) -> None:
    """Write the mean over rollouts of every metric in every window."""
    rows = [
        (metric, window, float(value), int(count))
        for metric, curve in tally.curves().items()
        for window, (value, count) in enumerate(zip(*curve, strict=True))
        if count
    ]
    pl.DataFrame(rows, schema=CURVE_SCHEMA, orient="row").write_parquet(target)
