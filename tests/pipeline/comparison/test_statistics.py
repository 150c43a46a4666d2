"""Means over seeds, ratios and truths whose values are known by hand."""

import numpy as np
import pytest

from infgen.metrics.long_term.protocols import FEATURES
from infgen.views.sheets import Measured
from pipeline.comparison.statistics import mean_curve, over_seeds, ratio, student_t, truth
from pipeline.stages.score.summary import Tally
from tests.pipeline.compared import scored


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [(1, 12.706), (2, 4.303), (10, 2.228), (11, 2.2010), (30, 2.0423), (1000, 1.9623)],
)
def test_students_t_is_that_of_the_books(degrees, expected):
    assert student_t(degrees) == pytest.approx(expected, abs=3e-4)


def test_over_three_seeds_the_half_width_is_t_times_the_standard_error():
    found = over_seeds([Measured(mean) for mean in (1.0, 2.0, 3.0)])

    half = 4.303 * 1.0 / np.sqrt(3)
    assert found.mean == 2.0
    assert (found.low, found.high) == pytest.approx((2 - half, 2 + half))


def test_one_seed_keeps_the_interval_of_its_scenes():
    alone = Measured(0.5, 0.4, 0.6)

    assert over_seeds([alone]) == alone
    assert over_seeds([Measured(None), alone]) == alone
    assert over_seeds([]) == over_seeds([Measured(None)]) == Measured(None)


def test_a_ratio_is_that_of_the_means_over_the_same_scenes():
    ours = scored("a", 0, {"one": {"ace": 1.0}, "two": {"ace": 3.0}})
    theirs = scored(
        "b", 0, {"one": {"ace": 4.0}, "two": {"ace": 4.0}, "three": {"ace": 99}}
    )

    found = ratio([ours], [theirs], "ace")

    assert found.mean == pytest.approx(0.5)
    assert (found.low, found.high) == pytest.approx((0.25, 0.75))  # One scene, twice.


def test_a_ratio_of_several_seeds_pairs_each_with_its_own():
    ours = [scored("a", seed, {"one": {"ace": seed + 1.0}}) for seed in (0, 1, 2)]
    theirs = [scored("b", seed, {"one": {"ace": 2.0}}) for seed in (2, 1)]

    found = ratio(ours, theirs, "ace")

    half = 12.706 * np.std([1.0, 1.5], ddof=1) / np.sqrt(2)
    assert found.mean == pytest.approx(1.25)
    assert found.high == pytest.approx(1.25 + half)


def test_a_scene_without_a_value_counts_for_neither_mean():
    ours = scored("a", 0, {"one": {"ace": 1.0}, "two": {}})
    theirs = scored("b", 0, {"one": {"ace": 2.0}, "two": {"ace": 6.0}})

    assert ratio([ours], [theirs], "ace").mean == pytest.approx(1 / 4)


@pytest.mark.parametrize("below", [0.0, float("nan")])
def test_nothing_is_divided_by_nothing(below):
    ours = scored("a", 0, {"one": {"ace": 1.0}})
    theirs = scored("b", 0, {"one": {"ace": below}})

    assert ratio([ours], [theirs], "ace") == Measured(None)
    assert ratio([ours], [theirs], "unknown") == Measured(None)
    assert ratio([ours], [], "ace") == Measured(None)


def test_the_ratio_of_a_composite_follows_from_the_features():
    features = {f"paper/{feature.name}": 0.6 for feature in FEATURES}
    halves = {name: 0.3 for name in features}
    ours = scored("a", 0, {"one": features, "two": features})
    theirs = scored("b", 0, {"one": halves, "two": halves})

    for name in ("composite", "placement", "kinematic"):
        found = ratio([ours], [theirs], f"paper/{name}")
        assert (found.mean, found.low, found.high) == pytest.approx((2.0, 2.0, 2.0))


def test_the_truth_is_the_mean_over_the_logs_that_have_it():
    logs = Tally({"a": {"x": 1.0}, "b": {"x": 2.0}, "c": {"x": float("nan")}})

    assert truth(logs, "x") == 1.5
    assert truth(logs, "y") is None
    assert truth(Tally({"a": {"x": float("nan")}}), "x") is None
    assert truth(Tally(), "x") is None


def test_a_mean_curve_is_the_mean_of_those_that_reach_so_far():
    found = mean_curve([np.array([1.0, 2.0, 3.0]), np.array([3.0, np.nan])])

    np.testing.assert_array_equal(found, [2.0, 2.0, 3.0])
