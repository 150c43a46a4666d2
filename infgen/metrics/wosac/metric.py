"""The Waymo Open Sim Agents Challenge metric, without TensorFlow.

Definitions: arXiv:2305.12032 and Waymo's published configurations. The metric is Waymo's;
docs say under which terms entries on their data may be evaluated.

Example:
    >>> from infgen.metrics import wosac
    >>> log = wosac.from_scene(scene)                     # doctest: +SKIP
    >>> wosac.score(log, rollouts, "wosac-2025").metametric  # doctest: +SKIP
    0.7451
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from infgen.metrics.kinematics import speed_valid
from infgen.metrics.likelihood import Histogram, bernoulli_log_likelihood, log_likelihood
from infgen.metrics.wosac.features import Features, concatenate, measure
from infgen.metrics.wosac.logged import (
    HISTORY_STEPS,
    LOG_STEPS,
    LogError,
    LoggedScene,
    from_scene,
)
from infgen.metrics.wosac.rollouts import (
    Rollouts,
    RolloutsError,
    from_rollouts,
    generated,
    played,
    simulated_part,
)
from infgen.metrics.wosac.versions import (
    INTERACTIVE,
    KINEMATIC,
    MAP_BASED,
    VERSIONS,
    Rule,
    Version,
)

__all__ = [
    "VERSIONS",
    "LogError",
    "LoggedScene",
    "Rollouts",
    "RolloutsError",
    "Scores",
    "from_rollouts",
    "from_scene",
    "mean_scores",
    "score",
    "score_versions",
]


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of one scene, under the official names; NaN where one is not measured.

    Attributes:
        scenario_id: Id of the log.
        version: Metric version.
    """

    scenario_id: str
    version: str
    metametric: float
    average_displacement_error: float
    min_average_displacement_error: float
    linear_speed_likelihood: float
    linear_acceleration_likelihood: float
    angular_speed_likelihood: float
    angular_acceleration_likelihood: float
    distance_to_nearest_object_likelihood: float
    collision_indication_likelihood: float
    time_to_collision_likelihood: float
    distance_to_road_edge_likelihood: float
    offroad_indication_likelihood: float
    traffic_light_violation_likelihood: float
    simulated_collision_rate: float
    simulated_offroad_rate: float
    simulated_traffic_light_violation_rate: float
    kinematic_metrics: float
    interactive_metrics: float
    map_based_metrics: float

    def numbers(self) -> dict[str, float]:
        """All scores by name."""
        return {k: v for k, v in asdict(self).items() if isinstance(v, float)}


def score(log: LoggedScene, rollouts: Rollouts, version: str = "wosac-2025") -> Scores:
    """Score the rollouts of one scene.

    What the log does not tell is not measured: red lights where its source records none,
    and road edges where the map has none. A bucket is the mean of what is measured, if that
    is at least half of its weight; without one of the buckets there is no metametric.

    Args:
        log: The scene, from ``from_scene``.
        rollouts: Its simulated futures (officially 32).
        version: A name in ``wosac_versions.VERSIONS``.

    Raises:
        RolloutsError: if the rollouts do not fit the log; the message says how.
        LogError: if an evaluated agent is not observed now.
        ValueError: if there is no such version.
    """
    return score_versions(log, rollouts, (version,))[0]


def score_versions(
    log: LoggedScene, rollouts: Rollouts, versions: Sequence[str]
) -> list[Scores]:
    """Score rollouts under several versions; features are measured once.

    Raises:
        As ``score``.
    """
    tables = [_version(name) for name in versions]
    log = simulated_part(log, rollouts)
    measured = {
        whole: measure_both(log, rollouts, whole_log=whole)
        for whole in sorted({table.whole_log for table in tables})
    }
    return [combine(log.scenario_id, *measured[t.whole_log], t) for t in tables]


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """Average every score over the scenes that have it, the metametric included.

    Raises:
        ValueError: if there is none, or versions are mixed.
    """
    names = {one.version for one in scores}
    if len(names) != 1:
        raise ValueError(f"cannot average scores of versions {sorted(names)}")
    numbers = [one.numbers() for one in scores]
    means = {name: _known_mean([n[name] for n in numbers]) for name in numbers[0]}
    return Scores(scenario_id="mean", version=names.pop(), **means)


def combine(
    scenario_id: str, logged: Features, simulated: Features, version: Version
) -> Scores:
    """Turn the features of the log and of the rollouts into one version's scores."""
    likelihoods = {
        rule.feature: float(_likelihood(rule, logged, simulated)) for rule in version.rules
    }
    buckets = {
        bucket: _weigh(
            [rule for rule in version.rules if rule.bucket == bucket], likelihoods
        )
        for bucket in (KINEMATIC, INTERACTIVE, MAP_BASED)
    }
    # A generated scene has no log it should be near (the official value is 0).
    displacement_m = simulated.average_displacement_error
    if version.whole_log:
        displacement_m = np.zeros_like(displacement_m)
    return Scores(
        scenario_id=scenario_id,
        version=version.name,
        metametric=_metametric(version, likelihoods, buckets),
        average_displacement_error=float(displacement_m.mean()),
        min_average_displacement_error=float(displacement_m.mean(axis=1).min()),
        simulated_collision_rate=_rate("collision_indication", logged, simulated),
        simulated_offroad_rate=_rate("offroad_indication", logged, simulated),
        simulated_traffic_light_violation_rate=_rate(
            "traffic_light_violation", logged, simulated
        ),
        **{f"{feature}_likelihood": value for feature, value in likelihoods.items()},
        **{
            f"{name}_metrics": found.value / found.weight for name, found in buckets.items()
        },
    )


def log_likelihoods(
    rule: Rule, logged: Features, simulated: Features
) -> tuple[Float32[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """Log-likelihood of each logged value of one feature, and which of them count.

    Of a histogram feature [object, step]; of an event [object].
    """
    if isinstance(rule.estimator, Histogram):
        values = getattr(logged, rule.feature)[0]
        pool = getattr(simulated, rule.feature)
        return log_likelihood(values, pool, rule.estimator), _counts(rule.feature, logged)
    only = logged.vehicle if rule.feature == "traffic_light_violation" else True
    happened = happens(rule.feature, logged, logged)[0] & only
    simulated_happened = happens(rule.feature, logged, simulated) & only
    likelihood = bernoulli_log_likelihood(happened, simulated_happened, rule.estimator)
    return likelihood, np.ones_like(happened)


def happens(
    feature: str, logged: Features, measured: Features
) -> Bool[np.ndarray, "rollout object"]:
    """Whether an event happens to an object at any step that the log shows it."""
    return (getattr(measured, feature) & logged.valid).any(axis=-1)


def _likelihood(rule: Rule, logged: Features, simulated: Features) -> np.float32:
    """Likelihood of one feature: one mean over all values that count; NaN without any."""
    if rule.feature in logged.not_measured:
        return np.float32(np.nan)
    values, counts = log_likelihoods(rule, logged, simulated)
    return np.exp(values[counts].mean(dtype=np.float32))


def _counts(feature: str, logged: Features) -> Bool[np.ndarray, "object step"]:
    """Which logged values are scored."""
    valid = logged.valid[0]
    if feature in ("linear_speed", "angular_speed"):
        return speed_valid(valid)
    if feature in ("linear_acceleration", "angular_acceleration"):
        return speed_valid(speed_valid(valid))
    if feature == "time_to_collision":
        return valid & logged.vehicle[:, None]
    return valid


def _rate(feature: str, logged: Features, simulated: Features) -> float:
    if feature in logged.not_measured:
        return math.nan
    return float(happens(feature, logged, simulated).mean())


class _Sum(NamedTuple):
    """Likelihoods of some features, weighted.

    Attributes:
        value: Their sum, each times its weight; NaN where too little is measured.
        weight: Of those that are measured.
        whole: Of all of them.
    """

    value: float
    weight: float
    whole: float


def _weigh(rules: Sequence[Rule], likelihoods: Mapping[str, float]) -> _Sum:
    """Add up a bucket's likelihoods; half of its weight must be measured."""
    # The official weights and scores are float32, summed in double.
    weights = {rule.feature: float(np.float32(rule.weight)) for rule in rules}
    known = {name: w for name, w in weights.items() if not math.isnan(likelihoods[name])}
    value = sum(weight * likelihoods[name] for name, weight in known.items())
    weight, whole = sum(known.values()), sum(weights.values())
    return _Sum(value if 2 * weight >= whole else math.nan, weight or math.nan, whole)


def _metametric(
    version: Version, likelihoods: Mapping[str, float], buckets: Mapping[str, _Sum]
) -> float:
    """Weighted mean of what is measured, in every bucket enough; NaN otherwise."""
    if any(math.isnan(bucket.value) for bucket in buckets.values()):
        return math.nan
    # Exactly the official sum, whose weights are 1 but for rounding, where nothing lacks.
    found = _weigh(version.rules, likelihoods)
    return found.value * (found.whole / found.weight)


def _known_mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def _version(name: str) -> Version:
    if name not in VERSIONS:
        raise ValueError(f"no metric {name!r}; there is {', '.join(VERSIONS)}")
    return VERSIONS[name]


def measure_both(
    log: LoggedScene, rollouts: Rollouts, *, whole_log: bool
) -> tuple[Features, Features]:
    """Features of the log and of the rollouts, over what a version scores."""
    objects = np.arange(len(log.sim_rows)) if whole_log else log.evaluated
    steps = slice(0, LOG_STEPS) if whole_log else slice(HISTORY_STEPS, LOG_STEPS)
    logged = measure(log, log.motion, objects, steps)
    if not whole_log:
        return logged, measure(log, played(log, rollouts), objects, steps)
    return logged, concatenate(
        [measure(log, one, objects, steps) for one in generated(log, rollouts)]
    )
