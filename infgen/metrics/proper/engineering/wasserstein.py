"""Wasserstein-1 distance of two samples, from histograms that add up over scenes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

BINS = 40


@dataclass(frozen=True, slots=True)
class Scale:
    """Equal bins over the values of one number; values beyond it count in the end bins.

    Attributes:
        name: As in tables.
        unit: Of the values.
        low: Left edge of the first bin.
        high: Right edge of the last bin.
    """

    name: str
    unit: str
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width of a bin: a distance is known to within it."""
        return (self.high - self.low) / BINS

    def count(self, values: np.ndarray) -> Float64[np.ndarray, " bin"]:
        """Count values by bin; those that are NaN nowhere."""
        known = values[~np.isnan(values)].astype(np.float64)
        place = np.floor((known - self.low) / self.width)
        place = np.clip(place, 0, BINS - 1).astype(np.int64)
        return np.bincount(place, minlength=BINS).astype(np.float64)


def distance(
    one: Float64[np.ndarray, "*shape bin"],
    other: Float64[np.ndarray, "*shape bin"],
    scale: Scale,
) -> Float64[np.ndarray, "*shape"]:
    """Wasserstein-1 distance in the unit of the values: the area between the distributions.

    NaN where either side has no values: that is not measured, and not 0.
    """
    shares = []
    for counts in (one, other):
        total = counts.sum(axis=-1, keepdims=True)
        shares.append(np.where(total > 0, counts / np.where(total > 0, total, 1), np.nan))
    apart = np.cumsum(shares[0] - shares[1], axis=-1)
    return np.abs(apart).sum(axis=-1) * scale.width
