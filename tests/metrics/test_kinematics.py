import numpy as np
import pytest

from infgen.metrics.kinematics import (
    central_difference,
    measure_kinematics,
    speed,
    speed_valid,
)

STEPS = 0.1 * np.arange(12)
FLAT = np.zeros(12, np.float32)


def measure(x_m, y_m=FLAT, z_m=FLAT, heading_rad=FLAT):
    return measure_kinematics(*(np.float32(v) for v in (x_m, y_m, z_m, heading_rad)))


def test_constant_speed_has_no_acceleration():
    found = measure(10 * STEPS)

    np.testing.assert_allclose(found.speed_mps[1:-1], 10.0, rtol=1e-5)
    np.testing.assert_allclose(found.accel_mps2[2:-2], 0.0, atol=1e-4)


def test_braking_is_a_negative_acceleration():
    found = measure(10 * STEPS - STEPS**2)  # 10 m/s, slowing by 2 m/s each second

    np.testing.assert_allclose(found.accel_mps2[2:-2], -2.0, atol=1e-3)


def test_speed_counts_climbing_unless_asked_for_the_plane():
    along, up = np.float32(3 * STEPS), np.float32(4 * STEPS)

    np.testing.assert_allclose(speed(along, FLAT, up)[1:-1], 5.0, rtol=1e-5)
    np.testing.assert_allclose(speed(along, FLAT)[1:-1], 3.0, rtol=1e-5)


def test_turning_through_pi_is_a_small_turn():
    heading = (np.pi - 0.2 + STEPS + np.pi) % (2 * np.pi) - np.pi  # crosses +pi
    found = measure(FLAT, heading_rad=heading)

    np.testing.assert_allclose(found.yaw_rate_rad_s[1:-1], 1.0, atol=1e-4)
    np.testing.assert_allclose(found.yaw_accel_rad_s2[2:-2], 0.0, atol=1e-3)


def test_ends_are_nan_once_for_speeds_and_twice_for_accelerations():
    found = measure(10 * STEPS)

    for values in (found.speed_mps, found.yaw_rate_rad_s):
        np.testing.assert_array_equal(np.isnan(values), [True] + [False] * 10 + [True])
    for values in (found.accel_mps2, found.yaw_accel_rad_s2):
        np.testing.assert_array_equal(
            np.isnan(values), [True] * 2 + [False] * 8 + [True] * 2
        )


def test_a_speed_needs_both_neighbours_but_not_the_step_itself():
    valid = np.array([1, 1, 0, 1, 1, 1], bool)

    np.testing.assert_array_equal(speed_valid(valid), [0, 0, 1, 0, 1, 0])


@pytest.mark.parametrize("shape", [(3,), (2, 5), (2, 3, 7)])
def test_a_central_difference_keeps_shape_and_type(shape):
    found = central_difference(np.ones(shape, np.float32))

    assert found.shape == shape
    assert found.dtype == np.float32
