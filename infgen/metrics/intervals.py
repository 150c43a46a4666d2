"""How sure a mean over scenes is: 95 % bootstrap intervals.

Scenes are drawn with replacement; the rollouts of a scene stay together.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

SHARE = 0.95
SCENES_PER_BLOCK = 1 << 20


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
    known = ~np.isnan(values)
    count = weights @ known
    total = weights @ np.where(known, values, 0.0)
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)


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
    scenes = len(values)
    mean = follow(scene_mean(values, np.ones((1, scenes))))[0]
    if scenes < 2 or resamples < 1:
        return Interval(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    random = np.random.default_rng(seed)
    drawn, block = [], max(1, SCENES_PER_BLOCK // scenes)
    for start in range(0, resamples, block):
        size = min(block, resamples - start)
        weights = random.multinomial(scenes, np.full(scenes, 1 / scenes), size=size)
        drawn.append(follow(scene_mean(values, weights.astype(np.float64))))
    tail = 100 * (1 - SHARE) / 2
    low, high = _percentiles(np.concatenate(drawn), [tail, 100 - tail])
    return Interval(mean, low, high)


def _percentiles(drawn: np.ndarray, shares: list[float]) -> np.ndarray:
    """Percentiles of each column, over the resamples that have a value."""
    found = np.full((len(shares), drawn.shape[1]), np.nan)
    for column in range(drawn.shape[1]):
        known = drawn[:, column][~np.isnan(drawn[:, column])]
        if len(known):
            found[:, column] = np.percentile(known, shares)
    return found
