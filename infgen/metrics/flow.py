"""Agent counts, entries and exits around the ego, the same way for logs and rollouts.

An agent enters when it is within the radius for the first time and exits when it is there
for the last time, whether it was inserted there or drove in. So the count at the end is the
count now plus entries minus exits; a rollout with the rates of its log has as many agents.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64

from infgen.clock import CLOCK
from infgen.metrics.traffic import Traffic

UNSEEN_TOKENS = 2
"""In the last second of a log, an exit cannot be told from a gap in the track."""


@dataclass(frozen=True, slots=True)
class FlowCounts:
    """Counts of some logs or rollouts.

    Attributes:
        came: Entries.
        went: Exits for good.
        agents: Agents present at the end of a token step, summed over all token steps.
        tokens: Token steps that were looked at.
    """

    came: int = 0
    went: int = 0
    agents: int = 0
    tokens: int = 0

    def __add__(self, other: "FlowCounts") -> "FlowCounts":
        return FlowCounts(
            self.came + other.came,
            self.went + other.went,
            self.agents + other.agents,
            self.tokens + other.tokens,
        )

    def per_token(self, count: int) -> float:
        """One of its counts per half second; NaN if none was looked at."""
        return count / self.tokens if self.tokens else np.nan


def count_flow(
    traffic: Traffic, radius_m: float, temporal_window_tokens: int | None = None
) -> FlowCounts:
    """Count agents around the ego, entries and exits after now, without the last second.

    Args:
        traffic: A log or a rollout.
        radius_m: Agents nearer to the ego are around it.
        temporal_window_tokens: Count as if there were so many token steps after now, and
            as much before as there is, in as many such windows as there is room for.
            Whoever is away for a while has gone for good in a log that ends before, so long
            rollouts are compared to short logs in windows as long as these.
    """
    motion, now, tokens = traffic.motion, traffic.now, traffic.future_tokens
    length = (
        tokens if temporal_window_tokens is None else min(tokens, temporal_window_tokens)
    )
    x_m, y_m = motion.x_m[0], motion.y_m[0]
    away_m = np.hypot(x_m - x_m[traffic.ego], y_m - y_m[traffic.ego])
    near = motion.valid[0] & (away_m < radius_m)
    near[traffic.ego] = False
    steps = now + 1 + CLOCK.steps_per_token * length
    return add_up(
        _count_window(near[:, first : first + steps], now)
        for first in CLOCK.steps_per_token * _windows(tokens, length)
    )


def _windows(tokens: int, length: int) -> Int64[np.ndarray, " window"]:
    """First tokens of windows that lie evenly from the first token to the last."""
    count = max(1, tokens // max(1, length))
    return np.rint(np.linspace(0, tokens - length, count)).astype(np.int64)


def _count_window(near: Bool[np.ndarray, "agent step"], now: int) -> FlowCounts:
    """Count in one window, from presence around the ego at each of its steps."""
    after = near.shape[1] - 1 - now
    tokens = max(0, after // CLOCK.steps_per_token - UNSEEN_TOKENS)
    ends = now + CLOCK.steps_per_token * np.arange(1, tokens + 1)
    first, last = _first_and_last(near)
    came, went = first > now, last >= now
    return FlowCounts(
        came=_within(first[came] - now - 1, tokens),
        went=_within(last[went] - now, tokens),
        agents=int(near[:, ends].sum()),
        tokens=tokens,
    )


def _first_and_last(
    near: Bool[np.ndarray, "agent step"],
) -> tuple[Int64[np.ndarray, " there"], Int64[np.ndarray, " there"]]:
    """First and last step of each agent that is ever there."""
    there = near[near.any(axis=1)]
    return there.argmax(axis=1), near.shape[1] - 1 - there[:, ::-1].argmax(axis=1)


def _within(steps_after: Int64[np.ndarray, " event"], tokens: int) -> int:
    return int((steps_after < tokens * CLOCK.steps_per_token).sum())


def add_up(turnovers: Iterable[FlowCounts]) -> FlowCounts:
    """Counts of all of them together."""
    return sum(turnovers, FlowCounts())
