"""Curves in the plane."""

import numpy as np
import pytest

from infgen.sources.towns.streets import curves


@pytest.mark.parametrize("turn_rad", [0.0, np.pi / 2, -np.pi / 3])
def test_joins_leave_and_arrive_in_the_given_directions(turn_rad):
    start = np.array([1.0, 2.0, 0.3])
    end = np.array([11.0, 2.0 + 10 * np.sign(turn_rad), 0.3 + turn_rad])

    xy_m = curves.join(start, end, 0.5)

    np.testing.assert_allclose(xy_m[[0, -1]], [start[:2], end[:2]], atol=1e-9)
    np.testing.assert_allclose(curves.start_pose(xy_m)[2], start[2], atol=0.1)
    np.testing.assert_allclose(curves.end_pose(xy_m)[2], end[2], atol=0.1)


def test_a_quarter_turn_is_joined_by_nearly_an_arc():
    xy_m = curves.join(np.array([10.0, 0.0, np.pi / 2]), np.array([0.0, 10.0, np.pi]), 0.25)

    np.testing.assert_allclose(np.linalg.norm(xy_m, axis=1), 10.0, atol=0.01)
    assert curves.length(xy_m) == pytest.approx(5 * np.pi, rel=1e-3)


def test_a_join_near_its_corner_on_one_side_does_not_swing_beyond_it():
    start, end = np.array([-2.0, 0.0, 0.0]), np.array([0.0, 30.0, np.pi / 2])

    xy_m = curves.join(start, end, 0.5)

    assert xy_m[:, 0].max() <= 1e-9
    assert xy_m[:, 1].min() >= -1e-9


def test_a_parallel_lies_to_the_left():
    line_m = np.column_stack([np.arange(5.0), np.zeros(5)])

    np.testing.assert_allclose(curves.offset(line_m, 2.0), line_m + np.array([0.0, 2.0]))


def test_a_chain_holds_a_point_where_two_curves_touch_once():
    one, two = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 0.0], [2.0, 0.0]])

    np.testing.assert_allclose(curves.chain(one, two), [[0, 0], [1, 0], [2, 0]])
    assert len(curves.chain(one, two + 0.5)) == 4


def test_points_of_a_curve_are_evenly_spaced():
    bent_m = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])

    even_m = curves.resample(bent_m, 1.0)

    assert len(even_m) == 8
    np.testing.assert_allclose(curves.arc_lengths(even_m), np.arange(8.0))
