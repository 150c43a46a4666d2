"""How likely logged values are under simulated ones: histograms and coin tosses.

Arithmetic and edges are those of the official metric, in float32. A value outside the range
counts in the end bins, and NaN in the last.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64


@dataclass(frozen=True, slots=True)
class Histogram:
    """Equal bins over a range.

    Attributes:
        low: Left edge of the first bin.
        high: Right edge of the last bin.
        bins: Number of bins.
        pseudocount: Added to the count of every bin.
        independent_steps: Pool all steps of an object, instead of one histogram per step.
        pool_objects: Pool all objects of a scene too.
    """

    low: float
    high: float
    bins: int
    pseudocount: float = 0.1
    independent_steps: bool = True
    pool_objects: bool = False

    @property
    def edges(self) -> Float32[np.ndarray, " edge"]:
        """Edges of the bins, exactly as the official metric has them.

        Multiples of a float32 width from ``low``, and ``high`` itself; numpy's and torch's
        ``linspace`` differ in the last bits, which moves values from bin to bin.
        """
        low, high = np.float32(self.low), np.float32(self.high)
        width = (high - low) / np.float32(self.bins)
        edges = low + np.arange(self.bins + 1, dtype=np.float32) * width
        edges[-1] = high
        return edges


@dataclass(frozen=True, slots=True)
class Bernoulli:
    """Yes or no.

    Attributes:
        pseudocount: Added to the count of either.
        pool_objects: Pool all objects of a scene.
    """

    pseudocount: float = 0.001
    pool_objects: bool = False


def bin_of(
    values: Float32[np.ndarray, "..."], histogram: Histogram
) -> Int64[np.ndarray, "..."]:
    """Bin of each value: ``[edge, next edge)``, the last closed; NaN is in the last."""
    edges = histogram.edges
    clipped = np.clip(values, edges[0], edges[-1])
    # NaN sorts behind every edge.
    bins = np.searchsorted(edges, clipped, side="right") - 1
    return np.minimum(bins, histogram.bins - 1)


def log_likelihood(
    logged: Float32[np.ndarray, "object step"],
    simulated: Float32[np.ndarray, "rollout object step"],
    histogram: Histogram,
) -> Float32[np.ndarray, "object step"]:
    """Log-probability of each logged value under the simulated values of its pool."""
    pool = _pools(logged.shape, histogram)
    bins = histogram.bins
    cell = pool * bins + bin_of(simulated, histogram)
    counts = np.bincount(cell.reshape(-1), minlength=(pool.max(initial=0) + 1) * bins)
    log_p = log_probabilities(counts.reshape(-1, bins), histogram.pseudocount)
    return log_p[pool, bin_of(logged, histogram)]


def bernoulli_log_likelihood(
    logged: Bool[np.ndarray, " object"],
    simulated: Bool[np.ndarray, "rollout object"],
    bernoulli: Bernoulli,
) -> Float32[np.ndarray, " object"]:
    """Log-probability of each object's logged event under the simulated events."""
    happened = simulated.sum(axis=0)
    counts = np.stack([len(simulated) - happened, happened], axis=1)  # [object, 2]
    if bernoulli.pool_objects:
        counts = np.broadcast_to(counts.sum(axis=0), counts.shape)
    log_p = log_probabilities(counts, bernoulli.pseudocount)
    return log_p[np.arange(len(logged)), logged.astype(np.int64)]


def log_probabilities(
    counts: Int64[np.ndarray, "pool bin"], pseudocount: float
) -> Float32[np.ndarray, "pool bin"]:
    """Log of smoothed relative frequencies."""
    smoothed = counts.astype(np.float32) + np.float32(pseudocount)
    return np.log(smoothed / smoothed.sum(axis=-1, keepdims=True))


def _pools(
    shape: tuple[int, ...], histogram: Histogram
) -> Int64[np.ndarray, "object step"]:
    """Number of the pool that each object and step belongs to."""
    objects, steps = np.indices(shape, dtype=np.int64)
    if histogram.pool_objects:
        objects = np.zeros_like(objects)
    return objects if histogram.independent_steps else objects * shape[1] + steps
