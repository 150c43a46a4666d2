import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.bicycle import (
    HEADING,
    SPEED,
    VehicleLimits,
    advance,
    curvature_per_m,
    follow_arc,
    stopping_acceleration,
    turn_wheels,
    wheelbase_of,
)

AT_10_MPS = np.array([1.0, 2.0, 0.0, 10.0])
ONE_METRE = np.arctan(3.0)
"""Steering of a car with axles 3 m apart whose rear wheels turn on a circle of a metre."""


def test_straight_ahead_is_speed_times_time():
    np.testing.assert_allclose(advance(AT_10_MPS, 0, 0, 3, 0.5), [6, 2, 0, 10])


def test_acceleration_adds_half_of_itself_times_the_square_of_time():
    np.testing.assert_allclose(advance(AT_10_MPS, 2, 0, 3, 1.0), [12, 2, 0, 12])


def test_in_reverse_it_goes_backwards():
    state = np.array([0, 0, np.pi / 2, -2.0])

    np.testing.assert_allclose(
        advance(state, 0, 0, 3, 1.0), [0, -2, np.pi / 2, -2], atol=1e-9
    )


def test_a_full_circle_leads_back():
    steering = 0.4
    around_m = 2 * np.pi / curvature_per_m(steering, 3.0)

    there = advance(AT_10_MPS, 0, steering, 3.0, around_m / 10)

    np.testing.assert_allclose(there, AT_10_MPS, atol=1e-9)


def test_the_centre_turns_on_the_circle_that_geometry_says():
    # The rear axle turns on a circle of 1 m; the centre is 1.5 m ahead of that axle.
    assert curvature_per_m(ONE_METRE, 3.0) == pytest.approx(1 / np.hypot(1, 1.5))


@pytest.mark.parametrize("side", [1, -1])
def test_half_a_circle_leads_to_its_other_side(side):
    radius_m = np.hypot(1, 1.5)

    there = follow_arc(np.zeros(3), np.pi * radius_m, side * ONE_METRE, 3.0)

    # The centre moves at the slip angle, of tangent 1.5, and the circle is square to it.
    slip_rad = np.arctan(1.5)
    across = 2 * radius_m * np.array([-np.sin(slip_rad), np.cos(slip_rad)])
    np.testing.assert_allclose(there[:2], across * [1, side], atol=1e-12)
    assert abs(there[HEADING]) == pytest.approx(np.pi)


def test_positive_steering_turns_left_and_in_reverse_the_heading_the_other_way():
    forward = advance(AT_10_MPS, 0, 0.1, 3, 0.1)
    back = advance(AT_10_MPS * [1, 1, 1, -1], 0, 0.1, 3, 0.1)

    assert forward[HEADING] > 0 > back[HEADING]
    assert forward[1] > 2 > back[1]


@given(
    speed=st.floats(-5, 30),
    acceleration=st.floats(-8, 4),
    steering=st.floats(-0.6, 0.6),
    parts=st.integers(2, 20),
)
def test_small_steps_lead_where_a_large_one_does(speed, acceleration, steering, parts):
    start = np.array([3.0, -4.0, 1.0, speed])
    state = start
    for _ in range(parts):
        state = advance(state, acceleration, steering, 2.8, 0.5 / parts)

    whole = advance(start, acceleration, steering, 2.8, 0.5)
    np.testing.assert_allclose(state[[0, 1, 3]], whole[[0, 1, 3]], atol=1e-9)
    assert np.cos(state[HEADING] - whole[HEADING]) == pytest.approx(1, abs=1e-12)


def test_many_cars_move_as_each_alone():
    states = np.array([AT_10_MPS, [0, 0, 1, 5], [0, 0, -1, -2.0]])
    steering, acceleration = np.array([0.1, 0, -0.2]), np.array([1.0, 0, 2])

    together = advance(states, acceleration, steering, np.array([3, 2.5, 4.0]), 0.1)

    for row, length in enumerate((3, 2.5, 4.0)):
        alone = advance(
            states[row], float(acceleration[row]), float(steering[row]), length, 0.1
        )
        np.testing.assert_array_equal(together[row], alone)


@pytest.mark.parametrize("speed", [0.3, -0.3, 0.0])
def test_brakes_stop_and_do_not_reverse(speed):
    acceleration = stopping_acceleration(speed, 8.0, 0.1)

    assert advance(np.array([0, 0, 0, speed]), acceleration, 0, 3, 0.1)[SPEED] == 0


def test_brakes_are_as_strong_as_they_are():
    assert stopping_acceleration(10.0, 8.0, 0.1) == -8
    assert stopping_acceleration(-10.0, 8.0, 0.1) == 8


def test_the_axles_of_a_car_of_five_metres_are_three_metres_apart():
    assert wheelbase_of(5.0) == pytest.approx(3.0)


def test_wheels_turn_at_their_rate_to_the_largest_angle_and_back():
    angle, seen = 0.0, []
    for wanted in [1] * 10 + [0] * 10:
        angle = turn_wheels(angle, wanted, 0.0, 3.0, 0.1)
        seen.append(angle)

    np.testing.assert_allclose(seen[:3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(seen[5:10], VehicleLimits().max_steering_rad)
    np.testing.assert_allclose(seen[10:12], [0.5, 0.4])
    assert seen[-1] == 0


@given(speed=st.floats(0, 40))
def test_steering_at_speed_keeps_to_the_lateral_acceleration(speed):
    angle = turn_wheels(0.0, 1.0, speed, 2.8, 10.0)

    lateral_mps2 = speed**2 * curvature_per_m(angle, 2.8)
    assert 0 < angle <= 0.6
    assert lateral_mps2 <= VehicleLimits().max_lateral_mps2 + 1e-9
