"""A sample of a split's logs: climatology, and the logs of situations like a scene's own.

Long rollouts outlive the log that they continue. Retrieval-based evaluation
(arXiv:2606.31209) holds them against logs of similar situations. What similar means, and
how a rollout is scored against several logs, is defined here: the numbers of
``context.CONTEXT`` in units of their standard deviation, and the mean of the fair scores
against each log.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from heapq import nsmallest

import numpy as np
from jaxtyping import Float32, Float64, Int64

from infgen.metrics.proper.context import CONTEXT
from infgen.metrics.proper.counts import Table, score_ensemble
from infgen.metrics.proper.course import Course
from infgen.metrics.proper.quantities import Forecast, read_course, read_courses

MOST_LOGS = 4096
"""Logs of a split that are kept, whatever its size."""
CLIMATOLOGY_LOGS = 128
"""The first of them are the climatology."""
NEIGHBOURS = 8
"""Logs that are retrieved for a scene."""


@dataclass(frozen=True, slots=True)
class LogCourse:
    """What is kept of a log.

    Attributes:
        scenario_id: Its id.
        context: Its situation, as in ``context.CONTEXT``.
        course: Its course.
    """

    scenario_id: str
    context: Float32[np.ndarray, " context"]
    course: Course


def sample_logs(logs: Iterable[LogCourse], most: int = MOST_LOGS) -> list[LogCourse]:
    """Draw a uniform sample by the hash of the id: the same in any order of the logs."""
    return nsmallest(most, logs, key=lambda log: (_hash(log.scenario_id), log.scenario_id))


def retrieve(
    scenario_id: str, context: Float32[np.ndarray, " context"], logs: Sequence[LogCourse]
) -> list[LogCourse]:
    """Find the logs of the situations most alike, nearest first, never the scene's own."""
    if not logs:
        return []
    known = np.stack([log.context for log in logs]).astype(np.float64)
    deviation = known.std(axis=0)
    scale = _weights() / np.where(deviation > 0, deviation, np.inf)
    distance = np.linalg.norm((known - context) * scale, axis=1)
    order: Int64[np.ndarray, " log"] = np.argsort(distance, kind="stable")
    others = [logs[row] for row in order.tolist() if logs[row].scenario_id != scenario_id]
    return others[:NEIGHBOURS]


def score_retrieved(members: Sequence[Course], neighbours: Sequence[LogCourse]) -> Table:
    """Score the courses of a scene's rollouts against the logs of similar situations.

    The mean of the fair scores against each. A window beyond the end of a log is held
    against its last window that has every number: traffic is taken to be stationary.

    Args:
        members: Courses of the rollouts, equally long.
        neighbours: From ``retrieve``.

    Raises:
        ValueError: if there are no rollouts or no neighbours.
    """
    if not neighbours:
        raise ValueError("there are no logs to score rollouts against")
    forecast = read_courses([_without_gaps(member) for member in members])
    windows = forecast.single.shape[1]
    scores = []
    for log in neighbours:
        truth = read_course(_without_gaps(log.course))
        at = np.minimum(np.arange(windows), len(truth.single) - 1)
        scores.append(score_ensemble(forecast, Forecast(*(part[at] for part in truth))))
    return np.mean(scores, axis=0)


def _without_gaps(course: Course) -> Course:
    """Leave out the last windows, where exits are not known; all, if no window has any."""
    known = np.flatnonzero(~np.isnan(course.exits).any(axis=1))
    return course.cut(int(known[-1]) + 1) if len(known) else course


def _weights() -> Float64[np.ndarray, " context"]:
    """Weight of each number, so that each group has the same in all."""
    groups = [group for _, group in CONTEXT]
    return np.array([groups.count(group) ** -0.5 for group in groups])


def _hash(scenario_id: str) -> bytes:
    return hashlib.sha256(scenario_id.encode()).digest()
