import numpy as np
import pytest

from infgen.metrics import intervals
from infgen.metrics.intervals import Bootstrap, bootstrap, scene_mean


def same(means):
    return means


def test_the_mean_leaves_out_scenes_without_a_value():
    values = np.array([[1.0, np.nan], [3.0, 5.0]])

    np.testing.assert_allclose(scene_mean(values, np.ones((1, 2))), [[2.0, 5.0]])


def test_the_interval_of_a_mean_is_that_of_the_normal_law():
    values = np.random.default_rng(0).normal(5.0, 2.0, (400, 1))
    found = bootstrap(values, same, 2000, seed=1)

    assert found.mean[0] == pytest.approx(values.mean())
    half = 1.96 * values.std() / 20
    assert found.high[0] - found.mean[0] == pytest.approx(half, rel=0.1)
    assert found.mean[0] - found.low[0] == pytest.approx(half, rel=0.1)


def test_equal_seeds_give_equal_intervals():
    values = np.random.default_rng(0).normal(size=(20, 3))

    one, two = (bootstrap(values, same, 100, seed=7) for _ in range(2))
    np.testing.assert_array_equal(one.low, two.low)


def test_what_follows_from_means_gets_its_own_interval():
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 9.0]])
    found = bootstrap(values, lambda m: m[:, :1] * m[:, 1:], 200, seed=0)

    assert found.mean[0] == pytest.approx(3.0 * 5.0)
    assert found.low[0] < found.mean[0] < found.high[0]


@pytest.mark.parametrize("scenes", [0, 1])
def test_hardly_any_scenes_have_no_interval(scenes):
    found = bootstrap(np.ones((scenes, 2)), same, 100, seed=0)

    assert np.isnan(found.low).all()
    assert np.isnan(found.mean).all() == (scenes == 0)


@pytest.mark.parametrize("scenes", [0, 1, 5])
def test_no_metrics_have_no_intervals(scenes):
    found = bootstrap(np.empty((scenes, 0)), same, 50, seed=0)

    assert [len(part) for part in found] == [0, 0, 0]


def test_a_metric_that_no_scene_has_stays_without_value():
    found = bootstrap(np.array([[1.0, np.nan]] * 5), same, 50, seed=0)

    assert np.isnan([found.mean[1], found.low[1], found.high[1]]).all()


def test_intervals_are_those_of_scenes_drawn_again(monkeypatch):
    monkeypatch.setattr(intervals, "METRICS_AT_ONCE", 2)
    monkeypatch.setattr(intervals, "DRAWN_AT_ONCE", 40)  # Blocks of few resamples.
    values = np.random.default_rng(0).normal(size=(12, 5))
    values[:4, 1], values[3:, 3] = np.nan, np.nan
    found = bootstrap(values, same, 50, seed=3)

    drawn = np.random.default_rng(3).multinomial(12, np.full(12, 1 / 12), size=50)
    means = scene_mean(values, drawn.astype(float))
    low, high = np.nanpercentile(means, [2.5, 97.5], axis=0)
    np.testing.assert_allclose(found.mean, np.nanmean(values, axis=0))
    np.testing.assert_allclose(found.low, low)
    np.testing.assert_allclose(found.high, high)


def test_tables_of_as_many_scenes_share_their_draws():
    values = np.random.default_rng(0).normal(size=(20, 3))
    shared = Bootstrap(100, seed=7)

    for table in (values, values[:9], values[:, :1]):
        one, two = shared.interval(table, same), bootstrap(table, same, 100, seed=7)
        np.testing.assert_array_equal(one.low, two.low)
        np.testing.assert_array_equal(one.high, two.high)
