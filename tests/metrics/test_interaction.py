import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.metrics.interaction import (
    NO_OBJECT_M,
    nearest_object_m,
    quad_distance_m,
    time_to_collision_s,
)
from infgen.metrics.motion import Motion
from tests.metrics.moving import boxes

STEPS = slice(1, 11)
FIRST = np.array([0])


def distance_m(*paths, **more):
    return nearest_object_m(boxes(*paths, **more), FIRST, STEPS)[0, 0]


def ttc_s(*paths, **more):
    return time_to_collision_s(boxes(*paths, **more), FIRST, STEPS)[0, 0]


def test_two_cars_three_metres_apart_are_three_metres_apart():
    # Bumper to bumper: centres 7 m apart, two half lengths of 2 m.
    np.testing.assert_allclose(distance_m((0, 0, 0, 0), (7, 0, 0, 0)), 3.0, atol=1e-5)


def test_cars_side_by_side_are_measured_across():
    np.testing.assert_allclose(distance_m((0, 0, 0, 0), (1, 5, 0, 0)), 3.0, atol=1e-5)


def test_corners_are_rounded():
    # Sharp corners would be at (2, 1) and (4, 4); rounding by 0.7 puts them 0.7 inside.
    core = np.hypot(2 + 1.4, 3 + 1.4) - 1.4

    np.testing.assert_allclose(distance_m((0, 0, 0, 0), (6, 5, 0, 0)), core, atol=1e-5)


def test_overlap_is_negative_by_its_depth():
    np.testing.assert_allclose(distance_m((0, 0, 0, 0), (3.5, 0, 0, 0)), -0.5, atol=1e-5)


def test_the_nearest_of_many_counts_not_the_first():
    found = distance_m((0, 0, 0, 0), (30, 0, 0, 0), (0, 6, 0, 0), (-20, 0, 0, 0))

    np.testing.assert_allclose(found, 4.0, atol=1e-5)


def test_a_long_truck_may_be_nearer_than_a_car_whose_centre_is_nearer():
    sizes = [(4, 2, 1.5), (4, 2, 1.5), (20, 2.5, 3)]
    found = distance_m((0, 0, 0, 0), (0, 8, 0, 0), (14, 0, 0, 0), size_lwh_m=sizes)

    np.testing.assert_allclose(found, 2.0, atol=1e-5)


def test_who_is_alone_or_not_there_has_no_neighbour():
    valid = np.ones((2, 11), bool)
    valid[1, 5:] = False
    found = distance_m((0, 0, 0, 0), (7, 0, 0, 0), valid=valid)

    np.testing.assert_array_equal(found[4:], NO_OBJECT_M)
    np.testing.assert_allclose(found[:4], 3.0, atol=1e-5)
    np.testing.assert_array_equal(distance_m((0, 0, 0, 0)), NO_OBJECT_M)


def brute_force_m(motion: Motion, row: int):
    """Nearest rounded box, by sampling outlines: slow, and near enough."""
    outlines = [_outline(motion, agent) for agent in range(motion.num_agents)]
    gaps = [
        np.linalg.norm(outlines[row][:, None] - other[None], axis=-1).min()
        for agent, other in enumerate(outlines)
        if agent != row
    ]
    return min(gaps)


def _outline(motion, agent, points=80):
    length, width, _ = motion.size_lwh_m[agent]
    r = 0.7 * min(length, width) / 2
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    round_xy = r * np.column_stack([np.cos(angle), np.sin(angle)])
    core = np.array([length / 2 - r, width / 2 - r])
    # A rounded rectangle is a circle pushed out to the core's corners, and its sides.
    corner_xy = round_xy + core * np.sign(round_xy)
    t = np.linspace(-1, 1, points)[:, None]
    sides = [
        np.column_stack([t * core[0], np.full_like(t, s * width / 2)]) for s in (-1, 1)
    ]
    sides += [
        np.column_stack([np.full_like(t, s * length / 2), t * core[1]]) for s in (-1, 1)
    ]
    xy = np.concatenate([corner_xy, *sides])
    c, s = np.cos(motion.heading_rad[0, agent, 1]), np.sin(motion.heading_rad[0, agent, 1])
    centre = np.array([motion.x_m[0, agent, 1], motion.y_m[0, agent, 1]])
    return xy @ np.array([[c, s], [-s, c]]) + centre


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_disjoint_boxes_are_as_far_apart_as_their_outlines(seed):
    random = np.random.default_rng(seed)
    # On a lattice with room for the largest box, so that nothing overlaps.
    spots = np.stack(np.meshgrid([-8, 0, 8], [-8, 0, 8]), axis=-1).reshape(-1, 2)
    paths = [(*spot, random.uniform(-3, 3), 0) for spot in random.permutation(spots)[:6]]
    sizes = np.column_stack(
        [random.uniform(0.5, 6, 6), random.uniform(0.5, 3, 6), np.ones(6)]
    )
    motion = boxes(*paths, size_lwh_m=sizes)

    found = nearest_object_m(motion, np.arange(6), slice(1, 2))[0, :, 0]
    for row in range(6):
        assert found[row] == pytest.approx(brute_force_m(motion, row), abs=0.08)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_pruning_never_changes_the_nearest_distance(seed):
    random = np.random.default_rng(seed)
    count = 8
    paths = [(*random.uniform(-12, 12, 2), random.uniform(-3, 3), 0) for _ in range(count)]
    sizes = np.column_stack(
        [random.uniform(0.3, 12, count), random.uniform(0.3, 3, count), np.ones(count)]
    )
    motion = boxes(*paths, size_lwh_m=sizes)
    found = nearest_object_m(motion, np.arange(count), slice(1, 2))[0, :, 0]

    for row in range(count):
        alone = [
            nearest_object_m(
                boxes(paths[row], paths[other], size_lwh_m=sizes[[row, other]]),
                FIRST,
                slice(1, 2),
            )[0, 0, 0]
            for other in range(count)
            if other != row
        ]
        assert found[row] == min(alone)


def test_the_distance_of_squares_is_known_by_hand():
    square = np.array([[1, -1, -1, 1], [1, 1, -1, -1]], np.float32)[..., None]
    aside = square + np.array([5, 0], np.float32)[:, None, None]
    diagonal = square + np.array([5, 6], np.float32)[:, None, None]
    inside = square + np.array([0.5, 0], np.float32)[:, None, None]

    assert quad_distance_m(square, aside)[0] == pytest.approx(3.0)
    assert quad_distance_m(square, diagonal)[0] == pytest.approx(5.0)
    assert quad_distance_m(square, inside)[0] == pytest.approx(-1.5)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-7, 8e-5, np.pi])
@pytest.mark.parametrize(
    "spot_m", [(0.12, 0.1), (1.5, 0.3), (2.9, 0.5), (2.0, 4.0), (6.0, 1.0)]
)
def test_sides_that_are_parallel_or_almost_hide_nothing(spot_m, turn_rad):
    # Far from the world's zero, where a corner is rounded to half a millimetre.
    along, aside = spot_m
    cos, sin = np.cos(1.0), np.sin(1.0)
    other = (-7798.0 + cos * along - sin * aside, -6676.0 + sin * along + cos * aside)
    found = distance_m(
        (-7798.0, -6676.0, 1.0, 0),
        (*other, 1.0 + turn_rad, 0),
        size_lwh_m=(4.3, 1.8, 1.5),
    )

    # Corners are rounded by 0.63 m, so the cores are 3.04 m by 0.54 m; of two parallel ones
    # the differences fill a rectangle of twice that.
    outside = np.array([along - 3.04, aside - 0.54])
    gap = np.hypot(*np.maximum(outside, 0)) + min(outside.max(), 0.0)
    np.testing.assert_allclose(found, gap - 2 * 0.63, atol=2e-3)


def test_a_stopped_car_ahead_is_met_after_the_gap_over_the_speed():
    # At step k the gap is 34 - 4 - k metres, closing at 10 m/s.
    found = ttc_s((0, 0, 0, 10), (34, 0, 0, 0))

    np.testing.assert_allclose(found[:-1], (30 - np.arange(1, 10)) / 10, rtol=1e-4)
    assert found[-1] == 5.0  # the last speed is not known


def test_time_to_collision_is_at_most_five_seconds():
    np.testing.assert_array_equal(ttc_s((0, 0, 0, 1), (50, 0, 0, 0)), 5.0)


@pytest.mark.parametrize(
    "other",
    [
        (-34, 0, 0, 0),  # behind
        (30, 0, 0, 20),  # gets away
        (34, 3.5, 0, 0),  # in the next lane
        (34, 0, np.pi / 2, 0),  # crosses
        (34, 2.4, 0.5, 0),  # hardly in the way, and not aligned
    ],
)
def test_who_is_not_followed_is_not_met(other):
    np.testing.assert_array_equal(ttc_s((0, 0, 0, 10), other), 5.0)


def test_who_overlaps_little_is_followed_if_aligned():
    # 0.4 m of overlap: enough only within ten degrees.
    assert ttc_s((0, 0, 0, 10), (34, 1.6, 0.0, 0))[0] < 3


def test_the_nearer_of_two_cars_ahead_is_followed():
    found = ttc_s((0, 0, 0, 10), (54, 0, 0, 0), (34, 0, 0, 0))

    np.testing.assert_allclose(found[:-1], (30 - np.arange(1, 10)) / 10, rtol=1e-4)


def test_yaws_on_either_side_of_pi_count_as_misaligned_as_officially():
    ego, lead = (0, 0, np.pi - 0.01, 10), (-34, 0, -np.pi + 0.01, 0)

    np.testing.assert_array_equal(ttc_s(ego, lead), 5.0)


def test_a_lead_that_is_not_there_is_not_met():
    valid = np.ones((2, 11), bool)
    valid[1] = False

    np.testing.assert_array_equal(ttc_s((0, 0, 0, 10), (34, 0, 0, 0), valid=valid), 5.0)
