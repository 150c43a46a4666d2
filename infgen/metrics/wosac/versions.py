"""Versions of the Waymo Open Sim Agents Challenge metric, as data.

A version's numbers never change: a test holds them all. Another number is another version.
Ranges and weights are Waymo's published configurations; 2024 and 2025 differ only in the
weights of road edges and red lights. The 2023 challenge had no red lights: they are
measured, and weigh nothing.
"""

from dataclasses import dataclass, replace

from infgen.metrics.likelihood import Bernoulli, Histogram

KINEMATIC, INTERACTIVE, MAP_BASED = "kinematic", "interactive", "map_based"


@dataclass(frozen=True, slots=True)
class Rule:
    """How one feature is scored.

    Attributes:
        feature: Official name.
        bucket: Group of features that it is averaged in.
        weight: Its share in the metametric.
        estimator: How its likelihood is estimated.
    """

    feature: str
    bucket: str
    weight: float
    estimator: Histogram | Bernoulli


@dataclass(frozen=True, slots=True)
class Version:
    """One published metric.

    Attributes:
        name: As on the command line.
        rules: One per feature, in the official order.
        whole_log: Score all 91 steps of all agents (scenario generation), instead of the
            80 simulated steps of the evaluated agents.
    """

    name: str
    rules: tuple[Rule, ...]
    whole_log: bool = False


def _histogram(
    feature: str, bucket: str, weight: float, low: float, high: float, bins: int
) -> Rule:
    return Rule(feature, bucket, weight, Histogram(low, high, bins))


def _bernoulli(feature: str, bucket: str, weight: float) -> Rule:
    return Rule(feature, bucket, weight, Bernoulli())


WOSAC_2025 = Version(
    "wosac-2025",
    (
        _histogram("linear_speed", KINEMATIC, 0.05, 0.0, 25.0, 10),
        _histogram("linear_acceleration", KINEMATIC, 0.05, -12.0, 12.0, 11),
        _histogram("angular_speed", KINEMATIC, 0.05, -0.628, 0.628, 11),
        _histogram("angular_acceleration", KINEMATIC, 0.05, -3.14, 3.14, 11),
        _histogram("distance_to_nearest_object", INTERACTIVE, 0.1, -5.0, 40.0, 10),
        _bernoulli("collision_indication", INTERACTIVE, 0.25),
        _histogram("time_to_collision", INTERACTIVE, 0.1, 0.0, 5.0, 10),
        _histogram("distance_to_road_edge", MAP_BASED, 0.05, -20.0, 40.0, 10),
        _bernoulli("offroad_indication", MAP_BASED, 0.25),
        _bernoulli("traffic_light_violation", MAP_BASED, 0.05),
    ),
)


def _reweighted(rule: Rule) -> Rule:
    weights = {"distance_to_road_edge": 0.1, "traffic_light_violation": 0.0}
    return replace(rule, weight=weights.get(rule.feature, rule.weight))


WOSAC_2024 = Version("wosac-2024", tuple(map(_reweighted, WOSAC_2025.rules)))

WOSAC_2023 = Version(
    "wosac-2023",
    (
        _histogram("linear_speed", KINEMATIC, 0.09, 0.0, 35.0, 10),
        _histogram("linear_acceleration", KINEMATIC, 0.09, -15.0, 15.0, 10),
        _histogram("angular_speed", KINEMATIC, 0.09, -31.5, 31.5, 10),
        _histogram("angular_acceleration", KINEMATIC, 0.09, -31.5, 31.5, 10),
        _histogram("distance_to_nearest_object", INTERACTIVE, 0.09, -5.0, 40.0, 10),
        _bernoulli("collision_indication", INTERACTIVE, 0.18),
        _histogram("time_to_collision", INTERACTIVE, 0.09, 0.0, 5.0, 10),
        _histogram("distance_to_road_edge", MAP_BASED, 0.09, -20.0, 40.0, 10),
        _bernoulli("offroad_indication", MAP_BASED, 0.18),
        _bernoulli("traffic_light_violation", MAP_BASED, 0.0),
    ),
)


def _pooled(rule: Rule) -> Rule:
    if rule.feature == "traffic_light_violation":
        return rule
    return replace(rule, estimator=replace(rule.estimator, pool_objects=True))


WOSAC_2025_SCENARIO_GEN = Version(
    "wosac-2025-scenario-gen", tuple(map(_pooled, WOSAC_2025.rules)), whole_log=True
)

VERSIONS = {
    version.name: version
    for version in (WOSAC_2023, WOSAC_2024, WOSAC_2025, WOSAC_2025_SCENARIO_GEN)
}
