import numpy as np

from infgen.metrics.proper.engineering.stops import stays_s
from infgen.metrics.proper.engineering.vehicles import see_vehicles
from tests.metrics.proper.roads import NOW, RADIUS_M, at_speeds, path, traffic, vehicles

EGO = (0.0, 0.0, 0.0, 0.0)


def test_speeds_are_those_of_the_steps_after_now_where_both_neighbours_are_seen():
    found = vehicles((0.0, 10.0, 0.0, 8.0))

    np.testing.assert_allclose(found.speed_mps[1, :-1], 8.0, atol=1e-4)
    assert np.isnan(found.speed_mps[:, -1]).all()
    np.testing.assert_allclose(found.accel_mps2[1, :-2], 0.0, atol=1e-2)


def test_acceleration_is_the_change_of_speed():
    steps = np.arange(61)
    x_m = 0.5 * 2.0 * (0.1 * steps) ** 2  # 2 m/s2.

    found = vehicles(path(x_m))

    np.testing.assert_allclose(found.accel_mps2[1, 1:-2], 2.0, atol=1e-2)


def test_only_vehicles_are_seen_and_only_the_near_are_near():
    seen = traffic(
        EGO,
        (70.0, 0.0, 0.0, 10.0),  # Beyond 75 m half a second after step 0.
        (5.0, 0.0, 0.0, 0.0),
        agent_type=np.array([0, 0, 1], dtype=np.int8),
        steps=21,
    )

    found = see_vehicles(seen, RADIUS_M, 19)

    assert found.near.shape == (2, 19)
    assert found.near[1].tolist() == [True] * 3 + [False] * 16  # Steps 2, 3 and 4.


def test_an_agent_stays_as_long_as_it_is_within_the_radius():
    leaves = path(at_speeds(70.0, (10.0, 60)))
    seen = traffic(EGO, leaves, (10.0, 0.0, 0.0, 0.0), (99.0, 0.0, 0.0, 0.0), steps=61)

    found = stays_s(seen, RADIUS_M, 60 - NOW)

    np.testing.assert_allclose(np.sort(found), [0.3, 5.9])  # Neither the ego nor the far.
