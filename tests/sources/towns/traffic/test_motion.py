"""Bodies that follow points, where the result can be computed by hand."""

import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.sources.towns.traffic.motion import AXLE, follow
from infgen.sources.towns.traffic.simulation import Played

STEPS = 120
TIME_S = CLOCK.step_s * np.arange(STEPS)


def played(path_m, heading_rad, speed_mps, present=None):
    present = np.ones(STEPS, bool) if present is None else present
    shown = np.where(present[:, None], path_m, 0.0)
    return Played(
        front_m=shown[None],
        heading_rad=np.where(present, heading_rad, 0.0)[None],
        speed_mps=np.where(present, speed_mps, 0.0)[None],
        present=present[None],
    )


def follow_one(one, length_m=5.0, walks=False):
    return follow(one, np.array([length_m]), np.array([walks]))


def straight(speed_mps=10.0):
    return np.column_stack([speed_mps * TIME_S, 0 * TIME_S])


def test_a_body_that_goes_straight_is_half_its_length_behind_its_front():
    bodies = follow_one(played(straight(), 0.0, 10.0))

    np.testing.assert_allclose(bodies.pose[0, :, 0], 10 * TIME_S - 2.5, atol=1e-9)
    np.testing.assert_allclose(bodies.pose[0, :, 1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(bodies.velocity_mps[0], [[10.0, 0.0]] * STEPS, atol=1e-9)


def test_the_point_of_a_walker_is_the_middle():
    bodies = follow_one(played(straight(1.3), 0.0, 1.3), walks=True)

    np.testing.assert_allclose(bodies.pose[0, :, 0], 1.3 * TIME_S, atol=1e-9)


def test_on_a_circle_the_body_points_inwards_by_what_its_axles_ask_for():
    # The rear axle runs on a circle too: sin(angle) = distance of the axles / radius.
    radius_m, speed_mps = 20.0, 5.0
    turn_rad = speed_mps * TIME_S / radius_m
    path_m = radius_m * np.column_stack([np.sin(turn_rad), 1 - np.cos(turn_rad)])

    bodies = follow_one(played(path_m, turn_rad, speed_mps))

    behind_rad = turn_rad - bodies.pose[0, :, 2]
    expected_rad = np.arcsin(AXLE * 5.0 / radius_m)
    # A step is half a metre: the rear follows half a step late.
    np.testing.assert_allclose(behind_rad[80:100], expected_rad, atol=0.015)
    yaw_rate = np.gradient(bodies.pose[0, :, 2], CLOCK.step_s)
    np.testing.assert_allclose(yaw_rate[80:100], speed_mps / radius_m, atol=0.005)


def test_a_snap_of_the_lane_does_not_snap_the_body():
    corner = 60
    path_m = straight(5.0)
    path_m[corner:, 1] = path_m[corner:, 0] - path_m[corner, 0]
    path_m[corner:, 0] = path_m[corner, 0]
    heading_rad = np.where(np.arange(STEPS) < corner, 0.0, np.pi / 2)

    bodies = follow_one(played(path_m, heading_rad, 5.0))

    turned_rad = np.abs(np.diff(bodies.pose[0, :, 2]))
    assert turned_rad.max() < 0.16  # The lane turns by 1.57 at once.
    assert bodies.pose[0, -1, 2] == pytest.approx(np.pi / 2, abs=0.1)


def test_who_stands_does_not_turn():
    bodies = follow_one(played(np.zeros((STEPS, 2)), 0.7, 0.0))

    np.testing.assert_allclose(bodies.pose[0, :, 2], 0.7)
    np.testing.assert_allclose(bodies.velocity_mps, 0.0)


def test_coming_and_going_bends_nobodys_path():
    there = (np.arange(STEPS) >= 30) & (np.arange(STEPS) < 90)

    bodies = follow_one(played(straight(), 0.0, 10.0, there))

    np.testing.assert_array_equal(bodies.present[0], there)
    shown_m = bodies.pose[0, there, 0]
    np.testing.assert_allclose(shown_m, 10 * TIME_S[there] - 2.5, atol=1e-9)


def test_who_leaps_is_gone():
    path_m = straight(1.0)
    path_m[70:] += [0.0, 9.0]

    bodies = follow_one(played(path_m, 0.0, 1.0), walks=True)

    np.testing.assert_array_equal(bodies.present[0], np.arange(STEPS) < 70)


def test_a_step_aside_is_spread_over_time():
    path_m = straight(1.3)
    path_m[60:] += [0.0, 1.0]

    bodies = follow_one(played(path_m, 0.0, 1.3), walks=True)

    assert bodies.present.all()
    assert np.abs(bodies.velocity_mps[0, :, 1]).max() < 0.6
    assert bodies.pose[0, -1, 1] == pytest.approx(1.0, abs=0.01)
