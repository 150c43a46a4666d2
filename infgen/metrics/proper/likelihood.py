"""Likelihood of logged outcomes under the rollouts of the same scene, window by window.

The direction of the official metric (arXiv:2305.12032), carried on as far as the log goes:
one histogram per agent, feature and window pools the steps of all rollouts. Its logarithm
is a proper score; it is averaged over scenes before it is turned back into a likelihood.
"""

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from infgen.metrics.long_term.protocols import STEP_FEATURES, Scoring
from infgen.metrics.proper.outcomes import GONE, UNKNOWN

PSEUDOCOUNT = 0.1
"""Added to the count of every outcome, of events too: 0.001 there would make one event in
32 rollouts that none foresaw cost as much as all else."""
MOST_EVENTS = 10
"""So many entries or exits in a window, or more, are one outcome ..."""
MOST_IN_RING = 3
"""... and so many in one ring."""


def step_log_likelihood(
    logged: UInt8[np.ndarray, "feature agent step"],
    members: UInt8[np.ndarray, "member feature agent step"],
    windows: int,
) -> Float64[np.ndarray, "feature window"]:
    """Mean log-likelihood of what happened to the agents, by feature and window.

    Args:
        logged: Outcomes of the log, from ``outcomes.align``.
        members: Outcomes of its rollouts.
        windows: Windows of equal length that the steps are cut into.
    """
    found = np.full((len(STEP_FEATURES), windows), np.nan)
    for row, feature in enumerate(STEP_FEATURES):
        outcomes = _number_outcomes(feature.histogram.bins)
        log = outcomes[_cut(logged[row], windows)]
        pool = outcomes[_cut(members[:, row], windows)]
        if feature.scoring is Scoring.EVENT:
            log, pool = _happens(log), _happens(pool)
        found[row] = _mean_log_p(log, pool, feature.histogram.bins + 1)
    return found


def count_log_likelihood(
    truth: Float64[np.ndarray, "window ring"],
    members: Float64[np.ndarray, "member window ring"],
    most: int,
) -> Float64[np.ndarray, " window"]:
    """Mean log-likelihood of counts under those of the rollouts, by window.

    Args:
        truth: Logged counts; NaN where they are not known.
        members: Simulated ones.
        most: Counts of so many and more are one outcome.
    """
    known = ~np.isnan(truth) & ~np.isnan(members).any(axis=0)
    log, pool = (
        np.where(known, np.minimum(x, most), UNKNOWN).astype(np.int64)[..., None]
        for x in (truth, members)
    )
    # Rings stand where agents do.
    return _mean_log_p(np.moveaxis(log, 1, 0), np.moveaxis(pool, 2, 1), most + 1)


def _number_outcomes(bins: int) -> Int64[np.ndarray, " outcome"]:
    """Number the outcomes of a feature: bins, and then being gone."""
    number = np.full(UNKNOWN + 1, UNKNOWN, dtype=np.int64)
    number[:bins], number[GONE] = np.arange(bins), bins
    return number


def _cut(outcome: np.ndarray, windows: int) -> np.ndarray:
    """Cut the last axis into windows [..., window, step]."""
    length = outcome.shape[-1] // max(1, windows)
    cut = outcome[..., : windows * length]
    return cut.reshape(*outcome.shape[:-1], windows, length)


def _happens(outcome: Int64[np.ndarray, "*shape step"]) -> Int64[np.ndarray, "*shape 1"]:
    """Whether an event (1) happens in a window, or not (0), or the agent is gone (2)."""
    yes, no = (outcome == 1).any(axis=-1), (outcome == 0).any(axis=-1)
    gone = (outcome == 2).any(axis=-1)
    found = np.where(yes, 1, np.where(no, 0, np.where(gone, 2, UNKNOWN)))
    return found[..., None]


def _mean_log_p(
    log: Int64[np.ndarray, "agent window step"],
    pool: Int64[np.ndarray, "member agent window step"],
    outcomes: int,
) -> Float64[np.ndarray, " window"]:
    """Mean log-probability of logged outcomes under the pool of their agent and window."""
    agents, windows = log.shape[:2]
    place = np.arange(agents * windows).reshape(agents, windows, 1) * outcomes
    cell = (place + pool)[pool != UNKNOWN]
    counts = np.bincount(cell, minlength=agents * windows * outcomes)
    smoothed = counts.reshape(agents * windows, outcomes) + PSEUDOCOUNT
    log_p = np.log(smoothed / smoothed.sum(axis=1, keepdims=True)).reshape(-1)
    known = log != UNKNOWN
    total = np.zeros(log.shape)
    total[known] = log_p[(place + log)[known]]
    count = known.sum(axis=(0, 2))
    mean = total.sum(axis=(0, 2)) / np.where(count > 0, count, 1)
    return np.where(count > 0, mean, np.nan)
