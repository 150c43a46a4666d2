import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infgen.tokens.clustering.kdisks import find_disks, mean_gap_m


class Plane:
    """Points of the plane: an item [2] is its own only point."""

    def __init__(self, allowed=None):
        self._allowed = allowed

    def points_m(self, items):
        return items[:, None].astype(np.float64)

    def mean(self, items):
        return items.mean(axis=0, dtype=np.float64).astype(np.float32)

    def allowed(self, items):
        if self._allowed is None:
            return np.ones(len(items), bool)
        return self._allowed(items)


def lay(items, tolerance_m, count=10**6, taken=(), order=None, space=None, **more):
    items = np.asarray(items, np.float32).reshape(-1, 2)
    taken = np.asarray(taken, np.float32).reshape(-1, 2)
    order = np.arange(len(items)) if order is None else order
    return find_disks(
        space or Plane(), items, order, float(tolerance_m), count, taken, **more
    )


def distances(one, two):
    return np.linalg.norm(one[:, None].astype(float) - two[None].astype(float), axis=-1)


def test_the_centre_of_a_disk_is_the_mean_of_its_members():
    centres = lay([[0, 0], [1, 0], [0.5, 0.75], [9, 9]], tolerance_m=2)
    np.testing.assert_allclose(centres, [[0.5, 0.25], [9, 9]])


def test_disks_are_laid_in_the_order_given():
    centres = lay([[0, 0], [10, 0], [20, 0]], 1, count=2, order=np.array([2, 0, 1]))
    np.testing.assert_array_equal(centres, [[20, 0], [0, 0]])


def test_what_is_near_a_taken_centre_is_covered_already():
    centres = lay([[0, 0], [1, 0], [5, 0]], tolerance_m=1, taken=[[0.5, 0]])
    np.testing.assert_array_equal(centres, [[5, 0]])


def test_a_mean_too_near_an_earlier_centre_gives_way_to_the_member_nearest_to_it():
    # All three are more than 1 from the origin; their mean (0, 1) is not.
    items = [[0.5, 0.95], [-0.5, 0.95], [0.0, 1.1]]
    centres = lay(items, tolerance_m=1.0, taken=[[0, 0]])
    np.testing.assert_array_equal(centres, np.float32([[0.0, 1.1]]))


def test_a_mean_that_is_no_allowed_item_gives_way_to_a_member():
    # Only corners of a ring are allowed; their mean is its middle.
    ring = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    space = Plane(lambda items: np.linalg.norm(items, axis=-1) > 0.9)
    centres = lay(ring, tolerance_m=3, space=space)
    assert len(centres) == 1
    assert centres[0].tolist() in ring.tolist()


def test_without_averages_the_seeds_are_the_centres():
    items = np.random.default_rng(0).normal(size=(200, 2)).astype(np.float32)
    centres = lay(items, 0.5, average=False)
    assert all(centre.tolist() in items.tolist() for centre in centres)


def test_no_items_give_no_centres_and_no_room_gives_none_either():
    assert lay([], 1).shape == (0, 2)
    assert lay([[1, 1]], 1, count=0).shape == (0, 2)


def test_far_is_the_mean_distance_of_points():
    square = np.array([[[0.0, 0], [0, 4]], [[3, 0], [0, 0]]])
    np.testing.assert_allclose(mean_gap_m(square, np.zeros((2, 2))), [2.0, 1.5])


@settings(max_examples=60)
@given(
    st.integers(0, 2**32),
    st.integers(0, 300),
    st.floats(0.01, 3),
    st.integers(0, 60),
    st.booleans(),
)
def test_centres_are_apart_and_all_items_covered(seed, many, tolerance, count, average):
    rng = np.random.default_rng(seed)
    items = (rng.normal(size=(many, 2)) * rng.uniform(0.1, 3)).astype(np.float32)
    taken = rng.normal(size=(3, 2)).astype(np.float32)
    taken = lay(taken, tolerance)  # apart, as centres are
    centres = lay(items, tolerance, count, taken, rng.permutation(many), average=average)

    everyone = np.concatenate([taken, centres])
    apart = distances(everyone, everyone) + 1e9 * np.eye(len(everyone))
    assert len(centres) <= count
    assert (apart > tolerance).all()
    if len(centres) < count and many:
        # An item is within the tolerance of a centre, or shares a disk with one.
        assert (distances(items, everyone).min(axis=1) <= 2 * tolerance + 1e-6).all()


def test_a_hundred_thousand_items_take_seconds():
    items = np.random.default_rng(0).normal(size=(100_000, 2)).astype(np.float32) * 3
    start = time.process_time()
    centres = lay(items, 0.05, count=2048)
    assert len(centres) == 2048
    assert time.process_time() - start < 20


def test_equal_work_gives_equal_bytes():
    items = np.random.default_rng(1).normal(size=(3000, 2)).astype(np.float32)
    order = np.random.default_rng(2).permutation(3000)
    assert lay(items, 0.3, order=order).tobytes() == lay(items, 0.3, order=order).tobytes()


@pytest.mark.parametrize("turn", [0.0, 0.5, np.pi / 2])
def test_the_strip_that_is_searched_misses_nothing_whichever_way_items_lie(turn):
    rng = np.random.default_rng(3)
    flat = rng.normal(size=(400, 2)) * [5, 0.2]
    cos, sin = np.cos(turn), np.sin(turn)
    items = (flat @ np.array([[cos, sin], [-sin, cos]])).astype(np.float32)
    centres = lay(items, 0.4, average=False)
    assert (distances(items, centres).min(axis=1) <= 0.4 + 1e-6).all()
