"""Counts around the ego: fair scores of an ensemble, and those of references of no model.

Every function returns one row per window and one column per name in
``quantities.SCORES``; NaN where something is not measured. Less is better.
"""

import numpy as np
from jaxtyping import Float64

from infgen.metrics.proper.course import Course
from infgen.metrics.proper.ensemble import fair_crps, fair_energy, point_energy
from infgen.metrics.proper.quantities import (
    SCORES,
    Forecast,
    keep_now,
    read_course,
)

Table = Float64[np.ndarray, "window score"]


_EXITS = SCORES.index("exits")


def score_ensemble(members: Forecast, truth: Forecast) -> Table:
    """Score an ensemble of courses against what happened.

    The distance of entries is scored as the CRPS of the number of entries nearer than a
    distance, averaged over distances: whoever has no entries has numbers too.
    """
    return np.column_stack(
        [
            fair_crps(members.single, truth.single),
            fair_crps(members.nearer, truth.nearer).mean(axis=-1),
            fair_energy(members.cells, truth.cells),
        ]
    )


def score_persistence(course: Course) -> Table:
    """Score "as many as now": certain, so its CRPS is the absolute error."""
    truth, kept = read_course(course), keep_now(course)
    return np.column_stack(
        [
            np.abs(kept.single - truth.single),
            np.abs(kept.nearer - truth.nearer).mean(axis=-1),
            point_energy(kept.cells, truth.cells),
        ]
    )


def score_climatology(course: Course, others: Forecast) -> Table:
    """Score the distribution of a split's logs, whatever the scene.

    Args:
        course: Of the log.
        others: Of other logs of the split (``pad_courses``), the scene's own left out.
            Those that end before a window, or have no number there, take no part in it.
    """
    truth = read_course(course)
    found = np.full((course.windows, len(SCORES)), np.nan)
    for window in range(min(course.windows, others.single.shape[1])):
        at = slice(window, window + 1)
        there = ~np.isnan(others.cells[:, window]).any(axis=1)
        those = Forecast(*(part[there, at] for part in others))
        exits = ~np.isnan(those.single[:, 0]).any(axis=1)
        now = Forecast(*(part[at] for part in truth))
        found[at] = score_ensemble(those, now)
        # Exits are not known in the last windows of the shorter logs.
        found[at, _EXITS] = score_ensemble(Forecast(*(part[exits] for part in those)), now)[
            :, _EXITS
        ]
    return found
