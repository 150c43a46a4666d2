"""Published numbers never change: another number needs another version name."""

import pytest

from infgen.metrics.likelihood import Bernoulli, Histogram
from infgen.metrics.wosac.versions import VERSIONS

# feature: weight, low, high, bins, pseudocount, or weight, pseudocount of a Bernoulli.
FROZEN = {
    "wosac-2025": {
        "linear_speed": (0.05, 0.0, 25.0, 10, 0.1),
        "linear_acceleration": (0.05, -12.0, 12.0, 11, 0.1),
        "angular_speed": (0.05, -0.628, 0.628, 11, 0.1),
        "angular_acceleration": (0.05, -3.14, 3.14, 11, 0.1),
        "distance_to_nearest_object": (0.1, -5.0, 40.0, 10, 0.1),
        "collision_indication": (0.25, 0.001),
        "time_to_collision": (0.1, 0.0, 5.0, 10, 0.1),
        "distance_to_road_edge": (0.05, -20.0, 40.0, 10, 0.1),
        "offroad_indication": (0.25, 0.001),
        "traffic_light_violation": (0.05, 0.001),
    },
    "wosac-2024": {
        "linear_speed": (0.05, 0.0, 25.0, 10, 0.1),
        "linear_acceleration": (0.05, -12.0, 12.0, 11, 0.1),
        "angular_speed": (0.05, -0.628, 0.628, 11, 0.1),
        "angular_acceleration": (0.05, -3.14, 3.14, 11, 0.1),
        "distance_to_nearest_object": (0.1, -5.0, 40.0, 10, 0.1),
        "collision_indication": (0.25, 0.001),
        "time_to_collision": (0.1, 0.0, 5.0, 10, 0.1),
        "distance_to_road_edge": (0.1, -20.0, 40.0, 10, 0.1),
        "offroad_indication": (0.25, 0.001),
        "traffic_light_violation": (0.0, 0.001),
    },
    "wosac-2023": {
        "linear_speed": (0.09, 0.0, 35.0, 10, 0.1),
        "linear_acceleration": (0.09, -15.0, 15.0, 10, 0.1),
        "angular_speed": (0.09, -31.5, 31.5, 10, 0.1),
        "angular_acceleration": (0.09, -31.5, 31.5, 10, 0.1),
        "distance_to_nearest_object": (0.09, -5.0, 40.0, 10, 0.1),
        "collision_indication": (0.18, 0.001),
        "time_to_collision": (0.09, 0.0, 5.0, 10, 0.1),
        "distance_to_road_edge": (0.09, -20.0, 40.0, 10, 0.1),
        "offroad_indication": (0.18, 0.001),
        "traffic_light_violation": (0.0, 0.001),
    },
}
FROZEN["wosac-2025-scenario-gen"] = FROZEN["wosac-2025"]
BUCKETS = ["kinematic"] * 4 + ["interactive"] * 3 + ["map_based"] * 3


def numbers(rule):
    estimator = rule.estimator
    if isinstance(estimator, Bernoulli):
        return rule.weight, estimator.pseudocount
    assert isinstance(estimator, Histogram)
    return (
        rule.weight,
        estimator.low,
        estimator.high,
        estimator.bins,
        estimator.pseudocount,
    )


def test_no_version_was_added_or_taken_away():
    assert sorted(VERSIONS) == sorted(FROZEN)


@pytest.mark.parametrize("version", FROZEN)
def test_a_versions_numbers_are_those_it_was_published_with(version):
    found = {rule.feature: numbers(rule) for rule in VERSIONS[version].rules}

    assert found == FROZEN[version]
    assert [rule.bucket for rule in VERSIONS[version].rules] == BUCKETS


def test_only_scenario_generation_pools_objects_and_scores_the_whole_log():
    for name, version in VERSIONS.items():
        generates = name == "wosac-2025-scenario-gen"
        assert version.whole_log == generates
        for rule in version.rules:
            pooled = generates and rule.feature != "traffic_light_violation"
            assert rule.estimator.pool_objects == pooled
            assert getattr(rule.estimator, "independent_steps", True)


def test_weights_of_the_challenges_sum_to_one_but_in_2023():
    sums = {name: sum(r.weight for r in v.rules) for name, v in VERSIONS.items()}

    assert sums["wosac-2023"] == pytest.approx(0.99)
    del sums["wosac-2023"]
    assert all(total == pytest.approx(1.0) for total in sums.values())
