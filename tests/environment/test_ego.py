"""Cars on bicycles and to waypoints go where one can compute in the head."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.environment.ego import (
    MAX_SPEED_MPS,
    EgoState,
    action_bounds,
    drive,
)
from infgen.geometry import to_world
from infgen.rollout.bicycle import advance, wheelbase_of

LENGTH_M = 5.0
ONE = np.ones(1, dtype=np.float32)


def car(speed_mps=10.0, pose=(0.0, 0.0, 0.0)):
    return EgoState.at(np.array([pose], dtype=np.float64), np.array([speed_mps]))


def bicycle(state, accel_mps2, steering_rad, steps=1):
    action = np.array([[accel_mps2, steering_rad]], dtype=np.float64)
    length_m = np.array([LENGTH_M], dtype=np.float32)
    return drive("bicycle", action, state, length_m, steps)


def test_a_car_that_nobody_touches_goes_on():
    (state,) = bicycle(car(10.0), 0.0, 0.0)

    np.testing.assert_allclose(state.pose, [[1.0, 0.0, 0.0]])
    assert state.speed_mps[0] == 10.0
    assert state.yaw_rate_rad_s[0] == 0.0


def test_acceleration_adds_half_a_t_squared():
    (state,) = bicycle(car(10.0), 2.0, 0.0)

    np.testing.assert_allclose(state.pose[0, 0], 10.0 * 0.1 + 0.5 * 2.0 * 0.1**2)
    np.testing.assert_allclose(state.speed_mps, 10.2)
    np.testing.assert_allclose(state.accel_mps2, 2.0)


def test_a_braking_car_stops_and_does_not_drive_backwards():
    # 0.4 m/s at 8 m/s2 are gone after 0.05 s and 0.01 m.
    stopped, still = bicycle(car(0.4), -8.0, 0.0, steps=2)

    np.testing.assert_allclose(stopped.pose, [[0.01, 0.0, 0.0]])
    assert stopped.speed_mps[0] == 0.0
    np.testing.assert_array_equal(still.pose, stopped.pose)


def test_nobody_gets_faster_than_the_greatest_speed():
    (state,) = bicycle(car(MAX_SPEED_MPS - 0.2), 4.0, 0.0)

    # 0.05 s to get there at a mean of 39.9 m/s, 0.05 s at 40 m/s.
    assert state.speed_mps[0] == MAX_SPEED_MPS
    np.testing.assert_allclose(state.pose[0, 0], 0.05 * 39.9 + 0.05 * 40.0)


@pytest.mark.parametrize("side", [1, -1])
def test_constant_steering_drives_a_circle(side):
    steering_rad = side * 0.3
    slip_rad = np.arctan(np.tan(abs(steering_rad)) / 2)
    radius_m = wheelbase_of(LENGTH_M) / 2 / np.sin(slip_rad)
    speed_mps = 2 * np.pi * radius_m / 10.0  # Once around in 100 steps.
    start = car(speed_mps, pose=(3.0, -2.0, 0.7))

    states = bicycle(start, 0.0, steering_rad, steps=100)

    np.testing.assert_allclose(states[-1].pose, start.pose, atol=1e-9)
    np.testing.assert_allclose(states[0].yaw_rate_rad_s, side * 2 * np.pi / 10.0)
    # The middle of the circle is square to the way the car moves, on the side it steers.
    way_rad = 0.7 + side * slip_rad
    middle_m = start.pose[0, :2] + side * radius_m * np.array(
        [-np.sin(way_rad), np.cos(way_rad)]
    )
    away_m = [np.linalg.norm(state.pose[0, :2] - middle_m) for state in states]
    np.testing.assert_allclose(away_m, radius_m)


def test_a_car_moves_as_the_bicycle_model_says():
    (state,) = bicycle(car(10.0, pose=(3.0, -2.0, 0.7)), 2.0, -0.2)

    start = np.array([3.0, -2.0, 0.7, 10.0])
    moved = advance(start, 2.0, -0.2, wheelbase_of(LENGTH_M), 0.1)
    np.testing.assert_allclose([*state.pose[0], state.speed_mps[0]], moved, rtol=1e-12)
    np.testing.assert_allclose(state.yaw_rate_rad_s[0], (moved[2] - 0.7) / 0.1)


def test_steering_turns_nobody_who_stands():
    (state,) = bicycle(car(0.0, pose=(1.0, 2.0, 0.5)), 0.0, 0.6)

    np.testing.assert_array_equal(state.pose, [[1.0, 2.0, 0.5]])


def test_longer_cars_turn_less():
    action = np.tile([0.0, 0.3], (2, 1))
    two = EgoState.at(np.zeros((2, 3)), np.full(2, 10.0))

    (state,) = drive("bicycle", action, two, np.array([5.0, 10.0], dtype=np.float32), 1)

    np.testing.assert_allclose(state.pose[0, 2], 2 * state.pose[1, 2])


def test_a_waypoint_is_where_the_car_is_after_the_step():
    start = car(4.0, pose=(10.0, 5.0, np.pi / 2))

    (state,) = drive("waypoint", np.array([[0.5, 0.1, 0.05]]), start, ONE, 1)

    # Facing north, ahead is +y and left is -x.
    np.testing.assert_allclose(state.pose, [[9.9, 5.5, np.pi / 2 + 0.05]])
    np.testing.assert_allclose(state.speed_mps, np.hypot(0.5, 0.1) / 0.1)
    np.testing.assert_allclose(state.accel_mps2, (state.speed_mps - 4.0) / 0.1)
    np.testing.assert_allclose(state.yaw_rate_rad_s, 0.5)


@given(
    st.tuples(st.floats(-5, 20), st.floats(-5, 5), st.floats(-0.75, 0.75)),
    st.floats(-3, 3),
)
def test_a_waypoint_of_five_steps_is_driven_straight_and_evenly(waypoint, heading_rad):
    start, action = car(0.0, pose=(2.0, 1.0, heading_rad)), np.array([waypoint])

    states = drive("waypoint", action, start, ONE, 5)

    end = to_world(action, start.pose)
    np.testing.assert_allclose(states[-1].pose[0, :2], end[0, :2], atol=1e-9)
    turned = np.exp(1j * states[-1].pose[0, 2]) / np.exp(1j * end[0, 2])
    np.testing.assert_allclose(turned, 1, atol=1e-9)
    for number, state in enumerate(states, 1):
        line_m = start.pose[0, :2] + number / 5 * (end - start.pose)[0, :2]
        np.testing.assert_allclose(state.pose[0, :2], line_m, atol=1e-9)


def test_bounds_of_waypoints_grow_with_the_length_of_a_step():
    low, high = action_bounds("waypoint", 0.5)
    short_low, short_high = action_bounds("waypoint", 0.1)

    np.testing.assert_allclose(low, 5 * short_low)
    np.testing.assert_allclose(high, [20.0, 5.0, 0.75])
    np.testing.assert_allclose(short_high, [4.0, 1.0, 0.15])


def test_bounds_of_bicycles_do_not():
    np.testing.assert_array_equal(
        action_bounds("bicycle", 0.5), action_bounds("bicycle", 0.1)
    )
