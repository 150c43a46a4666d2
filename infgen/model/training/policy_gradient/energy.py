"""Gradient of an energy score: what one value costs among those of all rollouts."""

import numpy as np
from jaxtyping import Float32


def energy_gradient(
    values: Float32[np.ndarray, " value"], logged: Float32[np.ndarray, " logged"]
) -> Float32[np.ndarray, " value"]:
    """Mean distance of each value to the logged ones less that to the other values.

    The energy score (Gneiting and Raftery 2007) is best where both have the same
    distribution, and there no value costs more than another. Zero where there is nothing
    logged, or only one value.
    """
    others = len(values) - 1
    if others < 1 or not len(logged):
        return np.zeros(len(values), dtype=np.float32)
    to_log = _summed_distance(values, logged) / len(logged)
    return (to_log - _summed_distance(values, values) / others).astype(np.float32)


def _summed_distance(values: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Sum the distances of each value to all others, of which it may be one."""
    ordered = np.sort(others.astype(np.float64))
    sums = np.concatenate([[0], np.cumsum(ordered)])
    below = np.searchsorted(ordered, values)
    at_most = values * below - sums[below]
    above: np.ndarray = sums[-1] - sums[below] - values * (len(ordered) - below)
    return at_most + above
