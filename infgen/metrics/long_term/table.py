"""One rollout's numbers under the names that tables use, and its curves over the windows.

Names: ``paper/linear_speed`` (protocol and feature, bucket or composite), ``ace/own_near``
and ``ace_slope/own_near`` (agent count error against the scene's own log, ``split`` the
mean of all logs, ``truth`` the same moment of a longer log; within the count radius or
``all``),
``agents/near`` (mean number), ``rate/entries`` (per second, at any distance),
``corrected/entry_rate`` (per second, where the protocol counts entries),
``corrected/collision_rate`` (share of agents and windows with a collision),
``corrected/inserted_offroad_rate`` (of agents not present now).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int16

from infgen.clock import CLOCK
from infgen.metrics.agent_count import count_errors, mean_counts, truth
from infgen.metrics.long_term.binned import Binned
from infgen.metrics.long_term.metric import BUCKETS, bucket_scores, composite, score_binned
from infgen.metrics.long_term.protocols import FEATURES, PROTOCOLS, ROW
from infgen.metrics.long_term.reference import events_per_token, happened
from infgen.metrics.windows import Windows, cut_windows

COMPOSITE, WITHOUT_PLACEMENT = "composite", "composite_without_placement"


@dataclass(frozen=True, slots=True)
class LogCounts:
    """Agents of one log at each step after now, the ego not counted.

    Attributes:
        near: Within the count radius.
        all: At any distance.
    """

    near: Int16[np.ndarray, " step"]
    all: Int16[np.ndarray, " step"]


@dataclass(frozen=True, slots=True)
class Against:
    """What rollouts are scored against.

    Attributes:
        log_p: Log-probabilities of the split (``reference.log_probabilities``).
        split_near: Mean over the split's logs of the agents near the ego.
        split_all: Mean over the split's logs of all agents.
        logs: Counts of each log, by scenario id.
        window_s: Length of a window.
        stride_s: From one window to the next.
    """

    log_p: Float64[np.ndarray, "protocol feature bin"]
    split_near: float
    split_all: float
    logs: Mapping[str, LogCounts]
    window_s: float
    stride_s: float

    def windows(self, num_steps: int) -> Windows:
        """Cut a future into windows."""
        return cut_windows(num_steps, self.window_s, self.stride_s)


@dataclass(frozen=True, slots=True)
class Row:
    """One rollout in the table.

    Attributes:
        numbers: Value of each metric; NaN where it has none.
        curves: Value of each metric that has one in every window.
    """

    numbers: Mapping[str, float]
    curves: Mapping[str, Float64[np.ndarray, " window"]]


def make_row(binned: Binned, against: Against) -> Row:
    """Score one rollout."""
    windows = against.windows(binned.bins.shape[-1])
    numbers: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    scores = score_binned(binned, against.log_p, windows)
    for at, protocol in enumerate(PROTOCOLS):
        for name, value in named(scores.overall[at][None]):
            numbers[f"{protocol.name}/{name}"] = float(value[0])
        for name, value in named(scores.windows[at].T):
            curves[f"{protocol.name}/{name}"] = value
        _add_rates(numbers, curves, binned, at, windows)
    _add_counts(numbers, curves, binned, against, windows)
    return Row(numbers, curves)


def named(
    features: Float64[np.ndarray, "row feature"],
) -> Iterator[tuple[str, Float64[np.ndarray, " row"]]]:
    """Name feature scores, and the buckets and composites that follow from them."""
    buckets = bucket_scores(features)
    yield COMPOSITE, composite(buckets, placement=True)
    yield WITHOUT_PLACEMENT, composite(buckets, placement=False)
    yield from ((name, buckets[..., at]) for at, name in enumerate(BUCKETS))
    yield from ((feature.name, features[..., at]) for at, feature in enumerate(FEATURES))


def _add_rates(
    numbers: dict[str, float],
    curves: dict[str, np.ndarray],
    binned: Binned,
    at: int,
    windows: Windows,
) -> None:
    """Add how often agents collide, are off-road, enter and leave by one protocol."""
    protocol = PROTOCOLS[at]
    everyone, late = np.ones_like(binned.there_now), ~binned.there_now
    for name, feature, who in (
        ("collision_rate", "collision_indication", everyone),
        ("offroad_rate", "offroad_indication", everyone),
        ("inserted_offroad_rate", "offroad_indication", late),
    ):
        bins = binned.bins[at, ROW[feature], :, : windows.num_steps]
        yes, counts = (pairs[who] for pairs in happened(bins, windows, protocol))
        total = counts.sum()
        rate = float((yes & counts).sum() / total) if total else float("nan")
        numbers[f"{protocol.name}/{name}"] = rate
    duration_s = windows.length * CLOCK.token_s
    for name, feature in (("entry_rate", "num_entries"), ("exit_rate", "num_exits")):
        events = events_per_token(binned, feature, protocol, windows.num_tokens)
        seconds = windows.num_tokens * CLOCK.token_s
        numbers[f"{protocol.name}/{name}"] = float(events.sum() / seconds)
        curves[f"{protocol.name}/{name}"] = windows.sum_tokens(events) / duration_s


def _add_counts(
    numbers: dict[str, float],
    curves: dict[str, np.ndarray],
    binned: Binned,
    against: Against,
    windows: Windows,
) -> None:
    """Add how many agents there are, how many come and go, and the count errors."""
    log = against.logs.get(binned.scenario_id)
    for who, number, split in (
        ("near", binned.num_near, against.split_near),
        ("all", binned.num_all, against.split_all),
    ):
        counts = mean_counts(number, windows)
        numbers[f"agents/{who}"] = float(counts.mean()) if windows.count else float("nan")
        curves[f"agents/{who}"] = counts
        own, true = _log_reference(log, who, windows, against)
        for name, reference in (("own", own), ("split", split), ("truth", true)):
            errors = count_errors(counts, reference)
            numbers[f"ace/{name}_{who}"] = errors.mean
            numbers[f"ace_slope/{name}_{who}"] = errors.slope
            curves[f"ace/{name}_{who}"] = errors.windows
    seconds = windows.num_tokens * CLOCK.token_s
    numbers["rate/entries"] = len(binned.entry_token) / seconds
    numbers["rate/exits"] = len(binned.exit_token) / seconds


def _log_reference(
    log: LogCounts | None, who: str, windows: Windows, against: Against
) -> tuple[float, Float64[np.ndarray, " window"]]:
    """Mean count of a scene's own log in its first window, and the truth of every window.

    A log of one window has no truth to compare the later ones with.
    """
    unknown = np.full(windows.count, np.nan)
    if log is None:
        return float("nan"), unknown
    number = log.near if who == "near" else log.all
    own = against.windows(len(number))
    first = float(mean_counts(number, own)[0])
    return first, truth(number, windows, own) if own.count > 1 else unknown
