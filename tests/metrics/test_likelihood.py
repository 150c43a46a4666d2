import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from infgen.metrics.likelihood import (
    Bernoulli,
    Histogram,
    bernoulli_log_likelihood,
    bin_of,
    log_likelihood,
)

TEN = Histogram(0.0, 10.0, 10)


def f32(*values):
    return np.array(values, dtype=np.float32)


def test_bins_hold_their_left_edge_and_the_last_its_right_edge_too():
    np.testing.assert_array_equal(bin_of(f32(0, 0.99, 1, 9.99, 10), TEN), [0, 0, 1, 9, 9])


def test_values_outside_count_in_the_end_bins_and_nan_in_the_last():
    np.testing.assert_array_equal(bin_of(f32(-5, 50, np.nan, np.inf), TEN), [0, 9, 9, 9])


def test_edges_are_multiples_of_a_float32_width():
    edges = Histogram(-12.0, 12.0, 11).edges

    assert edges.dtype == np.float32
    assert edges[6] == np.float32(1.0909099578857422)  # numpy's linspace has ...0908
    assert (edges[0], edges[-1]) == (-12.0, 12.0)


def test_a_value_that_was_always_simulated_is_almost_certain():
    logged, simulated = f32(3.5)[None], np.full((4, 1, 1), 3.5, np.float32)
    found = log_likelihood(logged, simulated, TEN)

    assert np.exp(found[0, 0]) == pytest.approx(4.1 / 5.0, rel=1e-6)


def test_a_value_that_was_never_simulated_gets_the_pseudocount():
    logged, simulated = f32(7.5)[None], np.full((4, 1, 1), 3.5, np.float32)

    assert np.exp(log_likelihood(logged, simulated, TEN)[0, 0]) == pytest.approx(0.1 / 5.0)


def test_steps_of_an_object_are_pooled_or_kept_apart_as_asked():
    logged = f32(1.5, 2.5)[None]
    simulated = np.stack([f32(1.5, 2.5)[None]] * 2)
    apart = Histogram(0.0, 10.0, 10, independent_steps=False)

    pooled = np.exp(log_likelihood(logged, simulated, TEN))
    separate = np.exp(log_likelihood(logged, simulated, apart))

    np.testing.assert_allclose(pooled, 2.1 / 5.0, rtol=1e-6)
    np.testing.assert_allclose(separate, 2.1 / 3.0, rtol=1e-6)


def test_objects_share_a_histogram_only_where_asked():
    logged = f32(1.5, 2.5)[:, None]
    simulated = logged[None]
    shared = Histogram(0.0, 10.0, 10, pool_objects=True)

    own = np.exp(log_likelihood(logged, simulated, TEN))
    together = np.exp(log_likelihood(logged, simulated, shared))

    np.testing.assert_allclose(own, 1.1 / 2.0, rtol=1e-6)
    np.testing.assert_allclose(together, 1.1 / 3.0, rtol=1e-6)


def test_an_event_is_as_likely_as_it_was_frequent():
    simulated = np.zeros((32, 2), bool)
    simulated[:8, 1] = True
    found = np.exp(
        bernoulli_log_likelihood(np.array([False, True]), simulated, Bernoulli())
    )

    np.testing.assert_allclose(found, [32.001 / 32.002, 8.001 / 32.002], rtol=1e-6)


def test_events_of_all_objects_are_pooled_where_asked():
    simulated = np.array([[True, False]] * 4)
    pooled = Bernoulli(pool_objects=True)
    found = np.exp(bernoulli_log_likelihood(np.array([True, True]), simulated, pooled))

    np.testing.assert_allclose(found, 4.001 / 8.002, rtol=1e-6)


@given(
    arrays.arrays(np.float32, (3, 2, 5), elements=st.floats(-20, 20, width=32)),
    st.permutations(range(3)),
)
def test_the_order_of_rollouts_does_not_matter(simulated, order):
    logged = simulated[0]

    np.testing.assert_array_equal(
        log_likelihood(logged, simulated, TEN),
        log_likelihood(logged, simulated[list(order)], TEN),
    )


@given(arrays.arrays(np.float32, (4, 1, 6), elements=st.floats(width=32)))
def test_probabilities_of_all_bins_sum_to_one(simulated):
    centres = (TEN.edges[:-1] + 0.5)[None]
    pool = np.repeat(simulated, 10, axis=2)[:, :, : 10 * 6]
    logged = np.resize(centres, (1, pool.shape[2]))

    found = np.exp(log_likelihood(logged, pool, TEN))[0, :10]
    assert found.sum() == pytest.approx(1.0, rel=1e-5)
