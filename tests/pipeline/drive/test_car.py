import numpy as np
import pytest

from pipeline.drive.car import (
    BRAKE_MPS2,
    ROLLING_MPS2,
    THROTTLE_MPS2,
    TICK_S,
    TICKS_PER_STEP,
    TICKS_PER_TOKEN,
    TOP_REVERSE_MPS,
    Car,
    Controls,
)

ORIGIN = np.zeros(3, dtype=np.float32)
ONE_SECOND = round(1 / TICK_S)


def driven(car, ticks, **controls):
    for _ in range(ticks):
        car = car.drive(Controls(**controls))
    return car


def test_twenty_ticks_are_a_token_step():
    assert pytest.approx(0.5) == TICKS_PER_TOKEN * TICK_S


def test_a_car_that_is_left_alone_rolls_out_and_stands():
    car = driven(Car.at(ORIGIN, 3.0, 5.0), ONE_SECOND)
    assert car.speed_mps == pytest.approx(3 - ROLLING_MPS2)

    car = driven(car, 20 * ONE_SECOND)
    assert car.speed_mps == 0
    assert car.pose[0] == pytest.approx(3.0**2 / (2 * ROLLING_MPS2), abs=0.05)


def test_full_throttle_from_a_stand_is_what_it_says():
    assert driven(Car.at(ORIGIN, 0.0, 5.0), 1, throttle=1.0).speed_mps == pytest.approx(
        THROTTLE_MPS2 * TICK_S
    )


def test_brakes_win_over_the_throttle():
    car = driven(Car.at(ORIGIN, 20.0, 5.0), ONE_SECOND, throttle=1.0, brake=1.0)

    assert car.speed_mps == pytest.approx(20 - BRAKE_MPS2 - ROLLING_MPS2)


def test_half_the_brake_is_half_as_strong():
    car = driven(Car.at(ORIGIN, 20.0, 5.0), ONE_SECOND, brake=0.5)

    assert car.speed_mps == pytest.approx(20 - BRAKE_MPS2 / 2 - ROLLING_MPS2)


def test_in_reverse_the_throttle_drives_backwards_up_to_a_walk():
    car = driven(Car.at(ORIGIN, 0.0, 5.0).shift(), 20 * ONE_SECOND, throttle=1.0)

    assert car.pose[0] < -10
    assert -TOP_REVERSE_MPS < car.speed_mps < -0.9 * TOP_REVERSE_MPS


def test_gears_are_shifted_in_a_stand_only():
    rolling, standing = Car.at(ORIGIN, 5.0, 5.0), Car.at(ORIGIN, 0.2, 5.0)

    assert not rolling.shift().reverse
    assert standing.shift().reverse
    assert not standing.shift().shift().reverse


@pytest.mark.parametrize(("steer", "sign"), [(1.0, 1), (-1.0, -1)])
def test_left_is_counter_clockwise(steer, sign):
    car = driven(Car.at(ORIGIN, 5.0, 5.0), ONE_SECOND, throttle=0.3, steer=steer)

    assert np.sign(car.pose[2]) == np.sign(car.pose[1]) == sign


def test_a_token_step_is_its_ticks():
    car, controls = Car.at(ORIGIN, 7.0, 4.5), Controls(0.4, 0.0, -0.5)

    path = car.drive_token(controls)

    for step in range(5):
        car = driven(car, TICKS_PER_STEP, throttle=0.4, steer=-0.5)
        np.testing.assert_array_equal(path[step], car.pose)
