"""Tables of the ``score`` stage: written part by part, joined without reading all."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.score_summary import Tally

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


class ScoreRow(NamedTuple):
    """One number of one rollout, or of a scene as a whole (``rollout`` None)."""

    scenario_id: str
    rollout: int | None
    metric: str
    value: float


def write_part(path: Path, rows: Sequence[ScoreRow]) -> None:
    """Write the rows of one unit; a metric without a value has no row."""
    known = [row for row in rows if not np.isnan(row.value)]
    pl.DataFrame(known, schema=SCHEMA, orient="row").write_parquet(path)


def join_parts(parts: Path, target: Path) -> None:
    """Join the parts in order, and remove them."""
    empty = pl.LazyFrame(schema=SCHEMA)
    frames = [pl.scan_parquet(path) for path in sorted(parts.glob("*.parquet"))]
    pl.concat([empty, *frames]).sink_parquet(target, maintain_order=True)
    shutil.rmtree(parts)


def write_curves(target: Path, tally: Tally) -> None:
    """Write the mean over rollouts of every metric in every window."""
    rows = [
        (metric, window, float(value), int(count))
        for metric, curve in tally.curves().items()
        for window, (value, count) in enumerate(zip(*curve, strict=True))
        if count
    ]
    pl.DataFrame(rows, schema=CURVE_SCHEMA, orient="row").write_parquet(target)
