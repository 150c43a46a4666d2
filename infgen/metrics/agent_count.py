"""Agent count error: does a simulation keep as many agents around the ego as the log?

SPEC 8.3: ``n(w)`` is the mean number of agents over window ``w``; the error is its distance
to a reference number, per window, and its slope over the windows says where it goes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int16

from infgen.clock import CLOCK
from infgen.metrics.windows import Windows


class CountErrors(NamedTuple):
    """Error of one rollout against one reference.

    Attributes:
        windows: Error in each window; NaN where the reference is not known.
        mean: Over the windows.
        slope: Per window, by least squares; NaN with less than two windows.
    """

    windows: Float64[np.ndarray, " window"]
    mean: float
    slope: float


def mean_counts(
    number: Int16[np.ndarray, " step"], windows: Windows
) -> Float64[np.ndarray, " window"]:
    """Mean number of agents in each window."""
    return windows.sum_steps(number) / (windows.length * CLOCK.steps_per_token)


def truth(
    number: Int16[np.ndarray, " step"], windows: Windows, own: Windows
) -> Float64[np.ndarray, " window"]:
    """Logged mean of each window of a rollout; NaN beyond the end of the log.

    Args:
        number: Logged agents at each step.
        windows: Windows of the rollout.
        own: Windows of the log.
    """
    known = mean_counts(number, own)[: windows.count]
    return np.concatenate([known, np.full(windows.count - len(known), np.nan)])


def count_errors(
    simulated: Float64[np.ndarray, " window"],
    reference: Float64[np.ndarray, " window"] | float,
) -> CountErrors:
    """Compare the counts of a rollout with a reference."""
    errors = np.abs(simulated - reference)
    known = np.flatnonzero(~np.isnan(errors))
    mean = float(errors[known].mean()) if len(known) else float("nan")
    return CountErrors(errors, mean, _slope(known, errors[known]))


def _slope(window: np.ndarray, errors: np.ndarray) -> float:
    if len(window) < 2:
        return float("nan")
    away = window - window.mean()
    return float((away * errors).sum() / (away**2).sum())
