"""A split's numbers by protocol ``proper``, from the means of its scenes' parts.

Everything follows from means over scenes, so that intervals come from drawing scenes again:
skill and spread-skill are ratios of means, likelihoods are taken from mean logarithms, and
histograms are added up before they are compared.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from infgen.metrics.long_term.protocols import FEATURES
from infgen.metrics.long_term.table import named
from infgen.metrics.proper.engineering.measure import SCALES
from infgen.metrics.proper.engineering.wasserstein import BINS, distance
from infgen.metrics.proper.ensemble import skill
from infgen.metrics.proper.quantities import QUANTITIES, SCORES
from infgen.metrics.proper.scene import (
    BESIDE_CLIMATOLOGY,
    CLIMATOLOGY,
    CONTEXT,
    ERROR,
    LOG_LIKELIHOOD,
    MODEL,
    PERSISTENCE,
    VARIANCE,
)
from infgen.metrics.proper.spread import flatness_error, spread_skill

Parts = Mapping[str, Float64[np.ndarray, "row value"]]

_FIXED = {
    **dict.fromkeys((MODEL, PERSISTENCE, CLIMATOLOGY), len(SCORES)),
    **dict.fromkeys((BESIDE_CLIMATOLOGY, CONTEXT), len(SCORES)),
    **dict.fromkeys((VARIANCE, ERROR), len(QUANTITIES)),
    LOG_LIKELIHOOD: len(FEATURES),
    **{f"{side}/{scale.name}": BINS for side in ("logs", "rollouts") for scale in SCALES},
}


def part_sizes(ranks: int) -> dict[str, int]:
    """Number of values of each part, where ranks are counted in so many."""
    return {**_FIXED, **{f"rank/{name}": ranks for name in QUANTITIES}}


def flatten(
    scenes: Sequence[Mapping[str, np.ndarray]], sizes: Mapping[str, int]
) -> Float64[np.ndarray, "scene column"]:
    """Lay the parts of scenes side by side; ranks of fewer rollouts end in zeros."""
    table = np.full((len(scenes), sum(sizes.values())), np.nan)
    for row, parts in zip(table, scenes, strict=True):
        start = 0
        for name, size in sizes.items():
            values = parts[name]
            row[start : start + len(values)] = values
            row[start + len(values) : start + size] = 0.0
            start += size
    return table


def split_numbers(
    means: Float64[np.ndarray, "row column"], sizes: Mapping[str, int]
) -> dict[str, Float64[np.ndarray, " row"]]:
    """Give the numbers of a split by name, from means of ``flatten``."""
    ends = np.cumsum(list(sizes.values()))[:-1]
    parts = dict(zip(sizes, np.split(means, ends, axis=1), strict=True))
    return dict(_numbers(parts))


def _numbers(parts: Parts) -> Iterator[tuple[str, np.ndarray]]:
    yield from _columns("", SCORES, parts[MODEL])
    against = skill(parts[MODEL], parts[PERSISTENCE])
    yield from _columns("skill_persistence/", SCORES, against)
    against = skill(parts[BESIDE_CLIMATOLOGY], parts[CLIMATOLOGY])
    yield from _columns("skill_climatology/", SCORES, against)
    yield from _columns("context/", SCORES, parts[CONTEXT])
    ratio = spread_skill(parts[VARIANCE], parts[ERROR])
    yield from _columns("spread_skill/", QUANTITIES, ratio)
    for name in QUANTITIES:
        yield f"rank_error/{name}", flatness_error(parts[f"rank/{name}"])
    for name, value in named(np.exp(parts[LOG_LIKELIHOOD])):
        yield f"likelihood/{name}", value
    for scale in SCALES:
        sides = [parts[f"{side}/{scale.name}"] for side in ("logs", "rollouts")]
        yield f"w1/{scale.name}", distance(sides[0], sides[1], scale)


def _columns(
    prefix: str, names: Sequence[str], values: np.ndarray
) -> Iterator[tuple[str, np.ndarray]]:
    for at, name in enumerate(names):
        yield f"{prefix}{name}", values[:, at]
