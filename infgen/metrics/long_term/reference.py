"""Counts of a whole split: what simulated traffic is compared with.

One accumulator per unit of work; accumulators add up in any order.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from infgen.metrics.likelihood import bin_of
from infgen.metrics.long_term.binned import NO_BIN, Binned, in_range
from infgen.metrics.long_term.protocols import (
    FEATURES,
    MAX_BINS,
    NUM_FEATURES,
    PROTOCOLS,
    ROW,
    STEP_FEATURES,
    Protocol,
    Scoring,
)
from infgen.metrics.placement import count_per_token
from infgen.metrics.windows import Windows


@dataclass(frozen=True, slots=True)
class Counts:
    """Histograms of all features under all protocols.

    Attributes:
        bins: Counts by bin; rows of fewer than ``MAX_BINS`` bins end in zeros.
    """

    bins: Int64[np.ndarray, "protocol feature bin"]

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(self.bins + other.bins)


def no_counts() -> Counts:
    """Start an accumulator."""
    shape = (len(PROTOCOLS), NUM_FEATURES, MAX_BINS)
    return Counts(np.zeros(shape, dtype=np.int64))


def add_up(counts: Iterable[Counts]) -> Counts:
    """Merge accumulators."""
    return sum(counts, start=no_counts())


def count_log(binned: Binned, windows: Windows) -> Counts:
    """Count a log: agents present now, over the first window after now (steps 11 to 90)."""
    found = no_counts()
    rows = np.flatnonzero(binned.there_now)
    one = Windows(min(windows.num_tokens, windows.length), windows.length, 1)
    for at, protocol in enumerate(PROTOCOLS):
        steps = binned.bins[at][:, rows, : one.num_steps]
        _count_steps(found.bins[at], steps, one, protocol)
        seen = max(0, one.num_tokens - protocol.unseen_tokens)
        _count_events(found.bins[at], binned, seen, protocol)
    return found


def count_simulated(binned: Binned, windows: Windows) -> Counts:
    """Count a rollout: all agents, every step once, events by window as they are scored."""
    found = no_counts()
    for at, protocol in enumerate(PROTOCOLS):
        steps = binned.bins[at][:, :, : windows.num_steps]
        _count_steps(found.bins[at], steps, windows, protocol)
        _count_events(found.bins[at], binned, windows.num_tokens, protocol)
    return found


def log_probabilities(counts: Counts) -> Float64[np.ndarray, "protocol feature bin"]:
    """Log-probability of every bin, smoothed; minus infinity beyond a feature's bins."""
    log_p = np.full(counts.bins.shape, -np.inf)
    for row, feature in enumerate(FEATURES):
        bins = feature.histogram.bins
        smoothed = counts.bins[:, row, :bins] + feature.histogram.pseudocount
        log_p[:, row, :bins] = np.log(smoothed / smoothed.sum(axis=-1, keepdims=True))
    return log_p


def divergence(one: Counts, other: Counts) -> Float64[np.ndarray, "protocol feature"]:
    """Jensen-Shannon divergence in bits, 0 to 1; NaN where either has no counts.

    A likelihood alone is best for traffic that always does the most common thing; this is
    best only for traffic whose values are spread as the log's.
    """
    return divergence_bits(one.bins, other.bins)


def divergence_bits(one: np.ndarray, other: np.ndarray) -> Float64[np.ndarray, "..."]:
    """Jensen-Shannon divergence of counts [..., bin] in bits; NaN where there are none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        p, q = (counts / counts.sum(axis=-1, keepdims=True) for counts in (one, other))
        middle = (p + q) / 2
        bits = [np.where(x > 0, x * np.log2(x / middle), x) for x in (p, q)]
    return np.asarray((bits[0] + bits[1]).sum(axis=-1) / 2)


def happened(
    bins: np.ndarray, windows: Windows, protocol: Protocol
) -> tuple[np.ndarray, np.ndarray]:
    """Whether an event happens to an agent in a window, and which of these pairs count.

    Args:
        bins: Bin 0 (no), 1 (yes) or ``NO_BIN`` [agent, step].
        windows: The windows.
        protocol: How absent agents count.

    Returns:
        Two arrays [agent, window].
    """
    yes = windows.sum_steps(bins == 1) > 0
    steps = windows.sum_steps(bins != NO_BIN)
    # Without a map no agent has an off-road value, nor counts as safe.
    measured = bool((bins != NO_BIN).any())
    absent_counts = protocol.absent_is_safe and measured
    return yes, np.ones_like(yes) if absent_counts else steps >= protocol.min_steps


def event_bins(
    binned: Binned, feature: str, protocol: Protocol
) -> tuple[Int64[np.ndarray, " event"], Int64[np.ndarray, " event"]]:
    """Half second and distance bin of the entries or exits that a protocol counts."""
    token, distance_m = (
        (binned.entry_token, binned.entry_distance_m)
        if feature in ("num_entries", "entry_distance")
        else (binned.exit_token, binned.exit_distance_m)
    )
    rule = FEATURES[ROW[feature]]
    counts = in_range(distance_m, rule, protocol) & (distance_m < protocol.event_radius_m)
    bins = bin_of(distance_m[counts], rule.histogram)
    return token[counts].astype(np.int64), bins.astype(np.int64)


def token_bins(
    binned: Binned, feature: str, protocol: Protocol, num_tokens: int
) -> Int64[np.ndarray, " token"]:
    """Bin of the number of entries or exits in each token step."""
    number = events_per_token(binned, feature, protocol, num_tokens)
    bins = bin_of(number.astype(np.float32), FEATURES[ROW[feature]].histogram)
    return bins.astype(np.int64)


def events_per_token(
    binned: Binned, feature: str, protocol: Protocol, num_tokens: int
) -> Int64[np.ndarray, " token"]:
    """Count the entries or exits in each token step, as far away as a protocol does."""
    token, distance_m = (
        (binned.entry_token, binned.entry_distance_m)
        if feature == "num_entries"
        else (binned.exit_token, binned.exit_distance_m)
    )
    return count_per_token(token, distance_m, protocol.event_radius_m, num_tokens)


def _count_steps(
    into: np.ndarray, bins: np.ndarray, windows: Windows, protocol: Protocol
) -> None:
    """Add the step features of some agents [feature, agent, step]."""
    for row, feature in enumerate(STEP_FEATURES):
        if feature.scoring is Scoring.STEPS:
            into[row] += np.bincount(bins[row].reshape(-1), minlength=256)[:MAX_BINS]
        else:
            yes, counts = happened(bins[row], windows, protocol)
            into[row, :2] += [int((counts & ~yes).sum()), int((counts & yes).sum())]


def _count_events(
    into: np.ndarray, binned: Binned, num_tokens: int, protocol: Protocol
) -> None:
    """Add entries and exits of the first token steps."""
    for name in ("num_entries", "num_exits"):
        bins = token_bins(binned, name, protocol, num_tokens)
        into[ROW[name]] += np.bincount(bins, minlength=MAX_BINS)
    for name in ("entry_distance", "exit_distance"):
        token, bins = event_bins(binned, name, protocol)
        into[ROW[name]] += np.bincount(bins[token < num_tokens], minlength=MAX_BINS)
