"""A split's numbers by protocol ``proper`` with their intervals, for ``summary.json``."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from infgen.config import ReferenceSettings
from infgen.metrics.intervals import Bootstrap
from infgen.metrics.proper.quantities import QUANTITIES
from infgen.metrics.proper.split import split_numbers
from pipeline.stages.score.gathered import RANKS, ProperTable


def summarize(
    table: ProperTable,
    sums: Mapping[str, np.ndarray],
    draws: Bootstrap,
    reference: ReferenceSettings,
) -> dict[str, Any]:
    """Give every number, JSON-able; one that is not measured is null.

    Args:
        table: Of all scored scenes.
        sums: Of their curves [value or count, window].
        draws: How scenes are drawn again.
        reference: How long a window is.
    """
    sizes = table.sizes
    names = list(split_numbers(np.full((1, sum(sizes.values())), np.nan), sizes))

    def follow(means: np.ndarray) -> np.ndarray:
        return np.stack(list(split_numbers(means, sizes).values()), axis=-1)

    found = draws.interval(table.values, follow)
    return {
        "scenes": len(table.values),
        "window_s": reference.proper_window_s,
        "windows": max((each.shape[1] for each in sums.values()), default=0),
        "numbers": {
            name: {
                "mean": _number(found.mean[at]),
                "low": _number(found.low[at]),
                "high": _number(found.high[at]),
            }
            for at, name in enumerate(names)
        },
        "ranks": {name: _ranks(table, name) for name in QUANTITIES},
    }


def _ranks(table: ProperTable, name: str) -> list[float]:
    """Share of each rank of the truth among the rollouts of its scene."""
    counts = table.part(f"{RANKS}{name}").sum(axis=0, dtype=np.float64)
    total = float(counts.sum())
    return [float(count) / total for count in counts] if total else []


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if np.isnan(value) else float(value)
