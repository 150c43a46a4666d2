"""All scores of one scene: its rollouts as an ensemble against its log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.metrics.intervals import scene_mean
from infgen.metrics.long_term.protocols import FEATURES
from infgen.metrics.proper.counts import (
    score_climatology,
    score_ensemble,
    score_persistence,
)
from infgen.metrics.proper.engineering.measure import SCALES
from infgen.metrics.proper.likelihood import (
    MOST_EVENTS,
    MOST_IN_RING,
    count_log_likelihood,
    step_log_likelihood,
)
from infgen.metrics.proper.outcomes import align
from infgen.metrics.proper.quantities import (
    QUANTITIES,
    SCORES,
    pad_courses,
    read_course,
    read_courses,
)
from infgen.metrics.proper.retrieval import LogCourse, score_retrieved
from infgen.metrics.proper.sample import Sample
from infgen.metrics.proper.spread import rank_counts, spread_and_error

MODEL, PERSISTENCE, CLIMATOLOGY = "model", "persistence", "climatology"
BESIDE_CLIMATOLOGY, CONTEXT = "beside_climatology", "context"
VARIANCE, ERROR, LOG_LIKELIHOOD = "variance", "error", "log_likelihood"


@dataclass(frozen=True, slots=True)
class References:
    """Logs that a scene is held against beside its own.

    Attributes:
        climatology: Some logs of the split, the scene's own left out.
        neighbours: Logs of situations like its own.
    """

    climatology: Sequence[LogCourse]
    neighbours: Sequence[LogCourse]


@dataclass(frozen=True, slots=True)
class SceneScores:
    """Scores of one scene; NaN where something is not measured.

    Attributes:
        parts: Means over the windows: ``model``, ``persistence``, ``climatology``,
            ``beside_climatology`` (the model in the windows that climatology has) and
            ``context`` with a value for each of ``quantities.SCORES``; ``variance`` and
            ``error`` for each of ``QUANTITIES``; ``log_likelihood`` for each of the
            long-term ``FEATURES``. ``rank/NAME`` counts ranks; ``logs/NAME`` and
            ``rollouts/NAME`` are histograms of what traffic engineers read.
        curves: Scores in each window by name.
    """

    parts: Mapping[str, Float64[np.ndarray, " value"]]
    curves: Mapping[str, Float64[np.ndarray, " window"]]


def score_scene(
    log: Sample, rollouts: Sequence[Sample], references: References
) -> SceneScores:
    """Score the rollouts of a scene.

    Args:
        log: Of the log.
        rollouts: Of its rollouts, over the same windows.
        references: What they are held against beside the log.

    Raises:
        ValueError: if there are no rollouts.
    """
    truth = read_course(log.course)
    members = read_courses([one.course for one in rollouts])
    model = score_ensemble(members, truth)
    tables = {MODEL: model, PERSISTENCE: score_persistence(log.course)}
    tables[CLIMATOLOGY] = np.full_like(model, np.nan)
    if references.climatology:
        others = pad_courses([one.course for one in references.climatology])
        tables[CLIMATOLOGY] = score_climatology(log.course, others)
    variance, error = spread_and_error(members.single, truth.single)
    likelihood = _log_likelihood(log, rollouts)
    context = np.full((1, len(SCORES)), np.nan)
    if references.neighbours:
        whole = [one.whole_course for one in rollouts]
        context = score_retrieved(whole, references.neighbours)
    known = ~np.isnan(tables[CLIMATOLOGY])
    parts = {name: _mean(table) for name, table in tables.items()}
    parts[BESIDE_CLIMATOLOGY] = _mean(np.where(known, model, np.nan))
    parts[CONTEXT] = _mean(context)
    parts[VARIANCE], parts[ERROR] = _mean(variance), _mean(error)
    parts[LOG_LIKELIHOOD] = _mean(likelihood)
    for at, name in enumerate(QUANTITIES):
        ranks = rank_counts(members.single[:, :, at], truth.single[:, at])
        parts[f"rank/{name}"] = ranks
    for scale in SCALES:
        pooled = sum(one.histograms[scale.name] for one in rollouts)
        parts[f"logs/{scale.name}"] = log.histograms[scale.name]
        parts[f"rollouts/{scale.name}"] = np.asarray(pooled) / len(rollouts)
    return SceneScores(parts, _curves(tables, likelihood))


def _log_likelihood(
    log: Sample, rollouts: Sequence[Sample]
) -> Float64[np.ndarray, "window feature"]:
    """Log-likelihoods of the long-term features, in their order."""
    windows = log.course.windows
    members = align(log.outcomes, [one.outcomes for one in rollouts])
    steps = step_log_likelihood(log.outcomes.outcome, members, windows)
    rows = list(steps)
    entries, exits = (
        (
            getattr(log.course, name).astype(np.float64),
            np.stack([getattr(one.course, name) for one in rollouts]).astype(np.float64),
        )
        for name in ("entries", "exits")
    )
    for truth, pool in (entries, exits):
        number = truth.sum(axis=1, keepdims=True), pool.sum(axis=2, keepdims=True)
        rows.append(count_log_likelihood(*number, MOST_EVENTS))
    rows += [count_log_likelihood(*pair, MOST_IN_RING) for pair in (entries, exits)]
    if len(rows) != len(FEATURES):
        raise ValueError(f"{len(rows)} likelihoods for {len(FEATURES)} features")
    return np.stack(rows, axis=1)


def _curves(
    tables: Mapping[str, np.ndarray], likelihood: np.ndarray
) -> dict[str, Float64[np.ndarray, " window"]]:
    found = {
        f"{name}/{label}": table[:, at]
        for name, table in tables.items()
        for at, label in enumerate(SCORES)
    }
    for at, feature in enumerate(FEATURES):
        found[f"{LOG_LIKELIHOOD}/{feature.name}"] = likelihood[:, at]
    return found


def _mean(table: Float64[np.ndarray, "window value"]) -> Float64[np.ndarray, " value"]:
    """Mean over the windows that have a value."""
    return scene_mean(table, np.ones((1, len(table))))[0]
