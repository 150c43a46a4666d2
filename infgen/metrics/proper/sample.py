"""What is kept of a log or a rollout until its scene is scored: little, of any length."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

from infgen.clock import CLOCK
from infgen.metrics.long_term.binned import Binned
from infgen.metrics.proper.course import Course, follow_course
from infgen.metrics.proper.engineering.measure import Place, measure
from infgen.metrics.proper.outcomes import Outcomes, read_outcomes
from infgen.metrics.traffic import Traffic
from infgen.metrics.windows import Windows, cut_windows


@dataclass(frozen=True, slots=True)
class Frame:
    """Where and how long a scene's log and rollouts are looked at.

    Attributes:
        windows: Windows side by side that the log and all rollouts have in common.
        window_s: Length of a window.
        radius_m: Around the ego.
        place: The scene's map and signals.
    """

    windows: Windows
    window_s: float
    radius_m: float
    place: Place

    @property
    def num_steps(self) -> int:
        """Steps after now that are looked at."""
        return self.windows.count * self.windows.length * CLOCK.steps_per_token


@dataclass(frozen=True, slots=True)
class Sample:
    """One log or rollout.

    Attributes:
        course: Over the windows that all have.
        whole_course: Over all windows of its own.
        outcomes: Of the agents that are there now.
        histograms: What traffic engineers read, by name.
    """

    course: Course
    whole_course: Course
    outcomes: Outcomes
    histograms: dict[str, Float64[np.ndarray, " bin"]]


def take_sample(
    traffic: Traffic,
    binned: Binned,
    ids: Int32[np.ndarray, " agent"],
    frame: Frame,
    *,
    logged: bool,
) -> Sample:
    """Keep what is scored of one log or rollout.

    Args:
        traffic: The log or rollout.
        binned: The same in bins, with boxes of its own.
        ids: Track ids of its agents.
        frame: What of it is looked at.
        logged: Whether it is the log, whose agents around the ego are those that count.
    """
    steps, radius_m = frame.num_steps, frame.radius_m
    after = traffic.motion.x_m.shape[2] - 1 - traffic.now
    whole = cut_windows(after, frame.window_s, frame.window_s)
    reach_m = radius_m if logged else np.inf
    return Sample(
        course=follow_course(traffic, radius_m, frame.windows),
        whole_course=follow_course(traffic, radius_m, whole),
        outcomes=read_outcomes(traffic, binned, ids, steps, reach_m),
        histograms=measure(traffic, frame.place, radius_m, steps),
    )
