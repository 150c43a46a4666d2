"""The paper's long-term score: simulated values under the distribution of a whole split.

Opposite to the Waymo metric, one histogram per feature holds all logged values, and the
simulated ones are scored under it, agent by agent and window by window (SPEC 8.1).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from infgen.metrics.long_term.binned import NO_BIN, Binned
from infgen.metrics.long_term.protocols import (
    COMPOSITE_WEIGHTS,
    FEATURES,
    NUM_FEATURES,
    PLACEMENT,
    PROTOCOLS,
    STEP_FEATURES,
    Feature,
    Protocol,
    Scoring,
)
from infgen.metrics.long_term.reference import event_bins, happened, token_bins
from infgen.metrics.windows import Windows

BUCKETS = tuple(COMPOSITE_WEIGHTS)


class Pairs(NamedTuple):
    """Likelihoods of one feature, to be averaged over agents and over windows.

    Attributes:
        total: Sum over agents (of logs, where ``geometric``) in each window.
        pairs: Pairs in each window.
        geometric: Whether the mean is taken of logs.
    """

    total: Float64[np.ndarray, " window"]
    pairs: Float64[np.ndarray, " window"]
    geometric: bool

    def per_window(self) -> Float64[np.ndarray, " window"]:
        """Score of each window; NaN where there is nothing to score."""
        mean = _ratio(self.total, self.pairs)
        return np.exp(mean) if self.geometric else mean

    def overall(self) -> float:
        """Score of all windows together: every pair weighs the same."""
        mean = _ratio(self.total.sum(keepdims=True), self.pairs.sum(keepdims=True))[0]
        return float(np.exp(mean) if self.geometric else mean)


@dataclass(frozen=True, slots=True)
class LongTermScores:
    """Scores of one rollout, or of a log scored as one; NaN where there is nothing.

    Attributes:
        overall: Score of each of ``FEATURES``.
        windows: The same for each window.
    """

    overall: Float64[np.ndarray, "protocol feature"]
    windows: Float64[np.ndarray, "protocol feature window"]


def score_binned(
    binned: Binned, log_p: Float64[np.ndarray, "protocol feature bin"], windows: Windows
) -> LongTermScores:
    """Score one rollout under the distribution of a split.

    Args:
        binned: The rollout.
        log_p: From ``reference.log_probabilities``.
        windows: Windows of the rollout.
    """
    overall = np.full((len(PROTOCOLS), NUM_FEATURES), np.nan)
    per_window = np.full((*overall.shape, windows.count), np.nan)
    for at in range(len(PROTOCOLS)):
        for row in range(NUM_FEATURES):
            pairs = _pairs(binned, at, row, log_p[at, row], windows)
            overall[at, row] = pairs.overall()
            per_window[at, row] = pairs.per_window()
    return LongTermScores(overall, per_window)


def bucket_scores(
    features: Float64[np.ndarray, "row feature"],
) -> Float64[np.ndarray, "row bucket"]:
    """Weighted mean of each bucket's features.

    A feature without a value is left out, but without entries or exits, the distance
    at which they do scores 0: otherwise doing nothing would be the best placement.
    """
    buckets = []
    for bucket in BUCKETS:
        rows = [row for row, feature in enumerate(FEATURES) if feature.bucket == bucket]
        weights = np.array([FEATURES[row].weight for row in rows])
        values = features[..., rows]
        zero = np.array([FEATURES[row].scoring is Scoring.DISTANCE for row in rows])
        known = ~np.isnan(values)
        total = (np.where(known, values, 0) * weights).sum(axis=-1)
        buckets.append(_ratio(total, ((known | zero) * weights).sum(axis=-1)))
    return np.stack(buckets, axis=-1)


def composite(
    buckets: Float64[np.ndarray, "row bucket"], *, placement: bool
) -> Float64[np.ndarray, " row"]:
    """Weigh the buckets to one number, with or without placement."""
    used = [b for b in BUCKETS if placement or b != PLACEMENT]
    weights = np.array([COMPOSITE_WEIGHTS[bucket] for bucket in used])
    values = buckets[..., [BUCKETS.index(bucket) for bucket in used]]
    return values @ weights / weights.sum()


def _pairs(binned: Binned, at: int, row: int, log_p: np.ndarray, windows: Windows) -> Pairs:
    feature, protocol = FEATURES[row], PROTOCOLS[at]
    if feature.scoring is Scoring.COUNT:
        return _count_pairs(binned, feature, protocol, log_p, windows)
    if feature.scoring is Scoring.DISTANCE:
        return _distance_pairs(binned, feature, protocol, log_p, windows)
    bins = binned.bins[at, row, :, : windows.num_steps]
    if feature.scoring is Scoring.EVENT:
        yes, counts = happened(bins, windows, protocol)
        total = (np.where(yes, log_p[1], log_p[0]) * counts).sum(axis=0)
        return Pairs(total, counts.sum(axis=0).astype(np.float64), geometric=True)
    there = binned.bins[at, _THERE, :, : windows.num_steps]
    return _step_pairs(bins, there, protocol, log_p, windows)


_THERE = next(
    row for row, feature in enumerate(STEP_FEATURES) if feature.name == "time_to_collision"
)
"""The feature that has a value wherever the agent is there."""


def _step_pairs(
    bins: np.ndarray,
    there: np.ndarray,
    protocol: Protocol,
    log_p: np.ndarray,
    windows: Windows,
) -> Pairs:
    """Geometric mean over the steps of each agent and window, then the sum over agents."""
    table = np.zeros(NO_BIN + 1)
    table[: len(log_p)] = np.where(np.isfinite(log_p), log_p, 0)
    total = windows.sum_steps(table[bins])
    steps = windows.sum_steps(bins != NO_BIN)
    counts = (steps > 0) & (windows.sum_steps(there != NO_BIN) >= protocol.min_steps)
    likelihood = np.exp(_ratio(total, steps))
    return Pairs(
        np.where(counts, likelihood, 0).sum(axis=0),
        counts.sum(axis=0).astype(np.float64),
        geometric=False,
    )


def _count_pairs(
    binned: Binned,
    feature: Feature,
    protocol: Protocol,
    log_p: np.ndarray,
    windows: Windows,
) -> Pairs:
    bins = token_bins(binned, feature.name, protocol, windows.num_tokens)
    total = windows.sum_tokens(log_p[bins])
    return Pairs(total, np.full(windows.count, float(windows.length)), geometric=True)


def _distance_pairs(
    binned: Binned,
    feature: Feature,
    protocol: Protocol,
    log_p: np.ndarray,
    windows: Windows,
) -> Pairs:
    token, bins = event_bins(binned, feature.name, protocol)
    covering = windows.covering(token).astype(np.float64)  # [event, window]
    total = np.exp(log_p[bins]) @ covering
    return Pairs(total, covering.sum(axis=0), geometric=False)


def _ratio(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Divide; NaN where there is nothing to divide by."""
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)
