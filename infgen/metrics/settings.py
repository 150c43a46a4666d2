"""Settings of stages ``reference`` and ``score``: how logs and rollouts are measured."""

from typing import Annotated

from pydantic import AfterValidator
from pydantic.dataclasses import dataclass

from infgen.clock import CLOCK
from infgen.settings import RULES, Count, NonNegative, Seed


def _whole_token_steps(seconds: float) -> float:
    CLOCK.tokens_in(seconds)
    return seconds


Window = Annotated[NonNegative, AfterValidator(_whole_token_steps)]


@dataclass(frozen=True, slots=True, config=RULES)
class ReferenceSettings:
    """How logs, and the rollouts that are scored against them, are cut into windows."""

    split: str = "validation"
    """Split of the logs: that of the rollouts."""
    window_s: Window = 8.0
    """Length of a window."""
    stride_s: Window = 0.5
    """Time from one window to the next."""
    count_radius_m: NonNegative = 75.0
    """Agents within this distance of the ego are counted. The agent count error is given
    for it and for no limit."""
    proper_window_s: Window = 2.0
    """Length of a window of protocol `proper`; its windows lie side by side."""


@dataclass(frozen=True, slots=True, config=RULES)
class ScoreSettings:
    """How rollouts are scored (METRICS.md)."""

    presence_radius_m: NonNegative = 0.0
    """For models that neither insert nor remove: an agent counts as present within this
    distance of the ego only, and enters or exits where it crosses it; 0 for no limit."""
    proper: bool = True
    """Score by protocol `proper` too, as far as the log goes."""
    wosac_version: str = "wosac-2025"
    """Version of the Waymo metric, computed on the first eight seconds."""
    bootstrap_resamples: Count = 1000
    """Bootstrap resamples of the scenes behind the 95 % intervals."""
    seed: Seed = 0
    """Seed of the bootstrap."""
