"""How sure a mean over scenes is: 95 % bootstrap intervals.

Scenes are drawn with replacement; the rollouts of a scene stay together.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

SHARE = 0.95
DRAWN_AT_ONCE = 1 << 22
"""Scenes that are drawn in a block of resamples, and the metrics that are summed up over
them at once: what bounds memory."""
METRICS_AT_ONCE = 256


class Interval(NamedTuple):
    """Means over scenes and where they may lie; NaN where no scene has a value.

    Attributes:
        mean: Over all scenes.
        low: Lower end.
        high: Upper end.
    """

    mean: Float64[np.ndarray, " metric"]
    low: Float64[np.ndarray, " metric"]
    high: Float64[np.ndarray, " metric"]


def scene_mean(
    values: Float64[np.ndarray, "scene metric"],
    weights: Float64[np.ndarray, "resample scene"],
) -> Float64[np.ndarray, "resample metric"]:
    """Weighted means over the scenes that have a value."""
    known = (~np.isnan(values)).astype(np.float64)
    count = weights @ known
    total = weights @ np.where(known, values, 0.0)
    return _divide(total, count)


class Bootstrap:
    """Draws scenes again, the same ones for every table of as many scenes.

    To draw takes as long as most sums over what is drawn, so draws are kept.
    """

    def __init__(self, resamples: int, seed: int) -> None:
        """Set how often scenes are drawn again, and the seed of all draws."""
        self._resamples, self._seed = resamples, seed
        self._drawn: dict[int, list[np.ndarray]] = {}

    def interval(
        self,
        values: Float[np.ndarray, "scene metric"],
        follow: Callable[[np.ndarray], np.ndarray],
    ) -> Interval:
        """Give means, and what follows from them, with their intervals.

        Args:
            values: One row per scene; NaN where it has no value.
            follow: Turns means [resample, metric] into numbers [resample, number].
        """
        scenes = len(values)
        drawn = self._draws(scenes) if scenes > 1 and self._resamples > 0 else []
        parts = range(0, max(1, values.shape[1]), METRICS_AT_ONCE)
        blocks = [
            _means(values[:, first : first + METRICS_AT_ONCE], drawn) for first in parts
        ]
        mean, *resampled = follow(np.concatenate(blocks, axis=1))
        if not resampled:
            return Interval(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
        tail = 100 * (1 - SHARE) / 2
        low, high = _percentiles(np.array(resampled), [tail, 100 - tail])
        return Interval(mean, low, high)

    def _draws(self, scenes: int) -> list[np.ndarray]:
        """How often each scene is drawn [resample, scene], in blocks of resamples."""
        if scenes not in self._drawn:
            self._drawn[scenes] = list(self._draw(scenes))
        return self._drawn[scenes]

    def _draw(self, scenes: int) -> Iterator[np.ndarray]:
        random = np.random.default_rng(self._seed)
        block = max(1, DRAWN_AT_ONCE // scenes)
        for start in range(0, self._resamples, block):
            size = min(block, self._resamples - start)
            counts = random.multinomial(scenes, np.full(scenes, 1 / scenes), size=size)
            yield counts.astype(np.min_scalar_type(counts.max()))


def _means(
    values: Float[np.ndarray, "scene metric"], drawn: Sequence[np.ndarray]
) -> Float64[np.ndarray, "resample metric"]:
    """Means over all scenes that have a value, and below over those of each draw."""
    known = ~np.isnan(values)
    filled = np.where(known, values, 0.0).astype(np.float64)
    distinct, which = _distinct_columns(known)
    means = []
    for counts in (np.ones((1, len(values))), *drawn):
        weights = counts.astype(np.float64)
        means.append(_divide(weights @ filled, (weights @ distinct)[:, which]))
    return np.concatenate(means)


def bootstrap(
    values: Float64[np.ndarray, "scene metric"],
    follow: Callable[[np.ndarray], np.ndarray],
    resamples: int,
    seed: int,
) -> Interval:
    """Give means, and what follows from them, with their intervals.

    Args:
        values: One row per scene; NaN where it has no value.
        follow: Turns means [resample, metric] into numbers [resample, number].
        resamples: How often scenes are drawn again.
        seed: Of the draws.
    """
    return Bootstrap(resamples, seed).interval(values, follow)


def _distinct_columns(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep each different column once, and say which of them every column is.

    Metrics mostly have values in the same scenes, and those are counted once.
    """
    places: dict[bytes, int] = {}
    which = [
        places.setdefault(packed.tobytes(), len(places))
        for packed in np.packbits(known, axis=0).T
    ]
    first = [which.index(place) for place in range(len(places))]
    return known[:, first].astype(np.float64), np.array(which, dtype=np.int64)


def _divide(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)


def _percentiles(drawn: np.ndarray, shares: list[float]) -> np.ndarray:
    """Percentiles of each column, over the resamples that have a value."""
    found = np.full((len(shares), drawn.shape[1]), np.nan)
    for column in range(drawn.shape[1]):
        known = drawn[:, column][~np.isnan(drawn[:, column])]
        if len(known):
            found[:, column] = np.percentile(known, shares)
    return found
