"""Our numbers are the official ones, value by value."""

import numpy as np
import pytest

from infgen.metrics.likelihood import Histogram
from infgen.metrics.wosac import metric
from infgen.metrics.wosac.features import Features
from infgen.metrics.wosac.metric import combine, happens, log_likelihoods, measure_both
from infgen.metrics.wosac.versions import VERSIONS
from infgen.sources.womd import iter_scenes
from tests.metrics.golden import (
    GOLDEN,
    SETS,
    golden_arrays,
    golden_configurations,
    golden_log,
    golden_metrics,
    golden_rollouts,
    golden_version,
    needs_goldens,
)

pytestmark = needs_goldens

EVENTS = ("collision_indication", "offroad_indication", "traffic_light_violation")
REPEATED = ("logged_raw", "logged_filled", "constvel")
SHIPPED = {
    "wosac-2023": "challenge_2023_legacy",
    "wosac-2024": "challenge_2024",
    "wosac-2025": "challenge_2025_sim_agents",
}
# Rounding of positions to float32 moves corners by half a millimetre in the official
# arithmetic; a distance between overlapping, noisy boxes feels it.
TOLERANCE = {
    "distance_to_nearest_object": 2e-3,
    "linear_speed": 1e-6,
    "linear_acceleration": 1e-6,
    "angular_speed": 1e-6,
    "angular_acceleration": 1e-5,
    "time_to_collision": 1e-5,
    "distance_to_road_edge": 1e-6,
}


@pytest.fixture(scope="module")
def measured():
    """Features of the log and of all rollouts, once per set."""
    known: dict[str, tuple[Features, Features]] = {}

    def features(name: str) -> tuple[Features, Features]:
        if name not in known:
            log = golden_log(name.split("/")[0])
            known[name] = measure_both(log, golden_rollouts(name), whole_log=False)
        return known[name]

    return features


@pytest.mark.parametrize("feature", TOLERANCE)
@pytest.mark.parametrize("name", SETS)
def test_features_of_log_and_first_rollout_are_the_official_ones(measured, name, feature):
    logged, simulated = measured(name)

    for ours, file in ((logged, "features_log"), (simulated, "features_sim_rollout0")):
        official = golden_arrays(name, file)[feature][0]
        found = getattr(ours, feature)[0]
        np.testing.assert_allclose(found, official, rtol=1e-5, atol=TOLERANCE[feature])


@pytest.mark.parametrize("name", SETS)
def test_the_displacement_of_the_first_rollout_is_the_official_one(measured, name):
    official = golden_arrays(name, "features_sim_rollout0")["average_displacement_error"]

    found = measured(name)[1].average_displacement_error[:1]
    np.testing.assert_allclose(found, official, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", SETS)
def test_no_step_of_the_first_rollout_has_another_event(measured, name):
    for ours, file in zip(
        measured(name), ("features_log", "features_sim_rollout0"), strict=True
    ):
        official = golden_arrays(name, file)
        np.testing.assert_array_equal(
            ours.collision_indication[0], official["collision_per_step"][0]
        )
        np.testing.assert_array_equal(
            ours.offroad_indication[0], official["offroad_per_step"][0]
        )
        np.testing.assert_array_equal(
            ours.traffic_light_violation[0], official["traffic_light_violation_per_step"][0]
        )


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("name", SETS)
def test_no_object_of_any_rollout_has_another_event(measured, name, event):
    logged, simulated = measured(name)
    official = golden_arrays(name, "loglik_challenge_2025_sim_agents")
    only = logged.vehicle if event == "traffic_light_violation" else True

    np.testing.assert_array_equal(
        happens(event, logged, logged)[0] & only, official[f"log_{event}"]
    )
    np.testing.assert_array_equal(
        happens(event, logged, simulated) & only, official[f"sim_{event}"]
    )


@pytest.mark.parametrize("name", SETS)
def test_log_likelihoods_per_object_are_the_official_ones(measured, name):
    official = golden_arrays(name, "loglik_challenge_2025_sim_agents")

    for rule in VERSIONS["wosac-2025"].rules:
        found, counts = log_likelihoods(rule, *measured(name))
        expected = official[f"ll_{rule.feature}"]
        # A value at a bin's edge may fall on its other side: at most one in a thousand.
        apart = ~np.isclose(found, expected, rtol=0, atol=1e-5)
        assert apart.mean() <= 1e-3, rule.feature
        if rule.feature in ("linear_speed", "angular_speed"):
            np.testing.assert_array_equal(counts, official["speed_validity"])
        if rule.feature in ("linear_acceleration", "angular_acceleration"):
            np.testing.assert_array_equal(counts, official["accel_validity"])


@pytest.mark.parametrize("configuration", golden_configurations() if SETS else ())
@pytest.mark.parametrize("name", SETS)
def test_every_score_is_the_official_one_from_features_to_metametric(
    measured, name, configuration
):
    if configuration not in golden_metrics(name):
        pytest.skip("the official package was not run with this configuration")
    official = golden_metrics(name)[configuration]
    found = combine(name, *measured(name), golden_version(configuration)).numbers()
    compared = {**official, **official["_buckets"]}

    for score in found.keys() & compared.keys():
        limit = 1e-5 if score == "metametric" else 5e-5
        assert found[score] == pytest.approx(compared[score], abs=limit), score
    assert set(official) - set(found) == {"scenario_id", "_buckets"}
    assert found["min_average_displacement_error"] == pytest.approx(
        official["_buckets"]["min_ade"], rel=1e-5
    )


@pytest.mark.parametrize("name", SETS)
def test_scores_from_the_raw_record_are_the_official_ones(name):
    scene = next(iter_scenes(GOLDEN / name.split("/")[0] / "scenario.tfrecord"))
    log = metric.from_scene(scene)

    scores = metric.score_versions(log, golden_rollouts(name), tuple(SHIPPED))

    for found in scores:
        official = golden_metrics(name)[SHIPPED[found.version]]
        for score, value in found.numbers().items():
            if score in official:
                limit = 1e-5 if score == "metametric" else 5e-5
                assert value == pytest.approx(official[score], abs=limit), score


@pytest.mark.parametrize("configuration", golden_configurations() if SETS else ())
def test_bin_edges_are_the_official_ones_to_the_last_bit(configuration):
    for feature, values in golden_configurations()[configuration].items():
        if feature.startswith("_") or values["estimator"] != "histogram":
            continue
        histogram = Histogram(values["min_val"], values["max_val"], values["num_bins"])
        official = [float.fromhex(edge) for edge in values["edges_hex"]]
        assert histogram.edges.tolist() == official, feature


@pytest.mark.parametrize("version", SHIPPED)
def test_shipped_versions_are_the_published_configurations(version):
    shipped, published = VERSIONS[version], golden_version(SHIPPED[version])

    for ours, theirs in zip(shipped.rules, published.rules, strict=True):
        assert ours.feature == theirs.feature
        assert np.float32(ours.weight) == np.float32(theirs.weight)
        assert type(ours.estimator) is type(theirs.estimator)
        for name in ("low", "high", "bins", "pseudocount", "independent_steps"):
            one, two = (getattr(r.estimator, name, None) for r in (ours, theirs))
            assert one == two or np.float32(one) == np.float32(two), (ours.feature, name)


@pytest.mark.parametrize("name", [name for name in SETS if name.endswith(REPEATED)])
def test_likelihoods_from_the_official_features_match_to_a_millionth(name):
    """The estimators alone, on sets whose rollouts are all the first one."""
    logged, simulated = (
        _official_features(name, file, rollouts)
        for file, rollouts in (("features_log", 1), ("features_sim_rollout0", 32))
    )

    for configuration, official in golden_metrics(name).items():
        found = combine(name, logged, simulated, golden_version(configuration)).numbers()
        for score, value in official.items():
            if score.endswith("_likelihood"):
                assert found[score] == pytest.approx(value, abs=1e-6), score


def _official_features(name: str, file: str, rollouts: int) -> Features:
    raw = golden_arrays(name, file)
    same = {
        key: np.repeat(raw[key], rollouts, axis=0)
        for key in (*TOLERANCE, "valid", "average_displacement_error")
    }
    red = np.repeat(raw["traffic_light_violation_per_step"], rollouts, axis=0)
    vehicle = raw["object_type"][0] == 1
    return Features(**same, traffic_light_violation=red, vehicle=vehicle)
