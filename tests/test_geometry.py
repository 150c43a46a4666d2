import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.geometry import (
    SQUARES_PER_COLUMN,
    box_corners,
    box_radius_m,
    boxes_overlap,
    grid_squares,
    to_local,
    wrap_angle,
)

CAR = np.array([4.0, 2.0])
FLAT = np.array([[0.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((3.9, 0.0, 0.0), True),
        ((4.1, 0.0, 0.0), False),
        ((0.0, 1.9, 0.0), True),
        ((0.0, 2.1, 0.0), False),
        ((2.9, 0.0, np.pi / 2), True),  # Across: half a length and half a width, 3 m.
        ((3.1, 0.0, np.pi / 2), False),
        ((3.0, 2.3, np.pi / 4), True),
        ((3.6, 2.6, np.pi / 4), False),  # Corner to corner: only the turned box tells.
    ],
)
def test_boxes_overlap_where_they_do(other, expected):
    assert boxes_overlap(FLAT, CAR, np.array([other]), CAR).tolist() == [expected]


def test_the_circle_around_a_box_holds_its_corners():
    assert box_radius_m(np.array([[3.0, 4.0], [0.0, 2.0]])).tolist() == [2.5, 1.0]


def test_boxes_that_touch_do_not_overlap():
    assert not boxes_overlap(FLAT, CAR, np.array([[4.0, 0.0, 0.0]]), CAR)[0]


def test_a_box_within_another_overlaps_it():
    assert boxes_overlap(FLAT, CAR, np.array([[0.3, 0.1, 1.0]]), CAR / 10)[0]


numbers = st.floats(-5, 5)
poses = st.tuples(numbers, numbers, st.floats(-3, 3)).map(np.array)
sizes = st.tuples(st.floats(0.5, 6), st.floats(0.5, 3)).map(np.array)


@given(poses, sizes, poses, sizes)
def test_overlap_is_mutual_and_seen_by_points_inside_both(one, size, other, other_size):
    found = boxes_overlap(one[None], size, other[None], other_size)[0]

    assert found == boxes_overlap(other[None], other_size, one[None], size)[0]
    if points_in_both(one, size, other, other_size):
        assert found


def points_in_both(one, size, other, other_size):
    (corners,) = box_corners(one[None], size)
    share = np.linspace(0.01, 0.99, 15)
    u, v = np.meshgrid(share, share)
    points = (
        corners[0]
        + u[..., None] * (corners[1] - corners[0])
        + v[..., None] * (corners[3] - corners[0])
    ).reshape(-1, 2)
    local = to_local(np.pad(points, ((0, 0), (0, 1))), np.tile(other, (len(points), 1)))
    return (np.abs(local[:, :2]) < other_size / 2 - 1e-9).all(axis=1).any()


def test_squares_above_each_other_are_consecutive_and_columns_far_apart():
    xy_m = np.array([[[1.0, 1.0], [9.9, 0.0]], [[1.0, 11.0], [-0.1, 1.0]]])

    number = grid_squares(xy_m, 10.0)

    assert number.tolist() == [[0, 0], [1, -SQUARES_PER_COLUMN]]


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_angles_wrap_to_the_bits_of_a_remainder(kind):
    turn, half = kind(2 * np.pi), kind(np.pi)
    ends = np.array([-half, half, 0.0, -0.0, -turn, turn, 3 * half, -3 * half], dtype=kind)
    near = [np.nextafter(ends, kind(way)) for way in (-9, 9)]
    wide = np.random.default_rng(0).uniform(-9, 9, 10_000).astype(kind)
    for angle_rad in (np.concatenate([ends, *near]), wide, 100 * wide):
        expected = (angle_rad + half) % turn - half
        expected = np.where(expected >= half, -half, expected)

        assert wrap_angle(angle_rad).tobytes() == expected.tobytes()
