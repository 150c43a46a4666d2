"""A split's numbers by protocol ``proper`` with their intervals, for ``summary.json``."""

from typing import Any

import numpy as np

from infgen.config import ReferenceSettings, ScoreSettings
from infgen.metrics.intervals import bootstrap
from infgen.metrics.proper.quantities import QUANTITIES
from infgen.metrics.proper.split import split_numbers
from pipeline.stages.score.proper import ProperTally


def summarize(
    tally: ProperTally, settings: ScoreSettings, reference: ReferenceSettings
) -> dict[str, Any]:
    """Give every number, JSON-able; one that is not measured is null.

    Args:
        tally: Of all scored scenes.
        settings: Of the intervals.
        reference: How long a window is.
    """
    sizes = tally.sizes
    names = list(split_numbers(np.full((1, sum(sizes.values())), np.nan), sizes))

    def follow(means: np.ndarray) -> np.ndarray:
        return np.stack(list(split_numbers(means, sizes).values()), axis=-1)

    found = bootstrap(tally.matrix(), follow, settings.bootstrap_resamples, settings.seed)
    return {
        "scenes": len(tally.parts),
        "window_s": reference.proper_window_s,
        "windows": max((sums.shape[1] for sums in tally.sums.values()), default=0),
        "numbers": {
            name: {
                "mean": _number(found.mean[at]),
                "low": _number(found.low[at]),
                "high": _number(found.high[at]),
            }
            for at, name in enumerate(names)
        },
        "ranks": {name: _ranks(tally, name) for name in QUANTITIES},
    }


def _ranks(tally: ProperTally, name: str) -> list[float]:
    """Share of each rank of the truth among the rollouts of its scene."""
    counts = np.zeros(tally.sizes[f"rank/{name}"])
    for parts in tally.parts.values():
        ranks = parts[f"rank/{name}"]
        counts[: len(ranks)] += ranks
    total = float(counts.sum())
    return [float(count) / total for count in counts] if total else []


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return None if np.isnan(value) else float(value)
