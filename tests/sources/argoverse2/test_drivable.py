import numpy as np

from infgen.sources.argoverse2.drivable import road_edges
from infgen.sources.polylines import densify, inside, kept_chains, resample, signed_area_m2


def box(x_m, y_m, width_m, height_m):
    corners = [(0, 0), (width_m, 0), (width_m, height_m), (0, height_m)]
    return np.array([(x_m + dx, y_m + dy, 0.0) for dx, dy in corners])


def length_m(lines):
    return sum(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in lines)


def test_one_area_is_bounded_by_its_own_outline_in_either_direction():
    for area in (box(0, 0, 10, 4), box(0, 0, 10, 4)[::-1]):
        (edge,) = road_edges([area], [])

        assert (edge[0] == edge[-1]).all()
        assert signed_area_m2(edge[:, :2]) == 40.0  # Counter-clockwise: road on the left.
        np.testing.assert_allclose(length_m([edge]), 28.0)


def test_the_border_of_areas_that_touch_is_no_edge():
    edges = road_edges([box(0, 0, 10, 4), box(10, 0, 10, 4)], [])

    np.testing.assert_allclose(length_m(edges), 48.0)  # Two boxes less twice the border.


def test_what_lies_within_another_area_is_no_edge():
    edges = road_edges([box(0, 0, 20, 20), box(5, 5, 4, 4)], [])

    np.testing.assert_allclose(length_m(edges), 80.0)


def test_areas_around_a_block_have_its_outline_clockwise():
    around = [box(0, 0, 30, 5), box(0, 25, 30, 5), box(0, 0, 5, 30), box(25, 0, 5, 30)]
    edges = road_edges(around, [])
    points_m = np.concatenate([edge[:, :2] for edge in edges])

    inner = [edge for edge in edges if np.abs(edge[:, :2] - 15).max() < 12]
    assert len(points_m) > 300
    assert {round(length_m([edge])) for edge in inner} == {20}
    for edge in inner:  # The block, with its middle at (15, 15), is on the right.
        ahead, across = edge[-1, :2] - edge[0, :2], np.array([15.0, 15.0]) - edge[0, :2]
        assert ahead[0] * across[1] - ahead[1] * across[0] < 0


def test_an_outline_across_a_lane_is_the_end_of_the_map_and_no_edge():
    lane = np.column_stack([np.linspace(0, 40, 41), np.full(41, 2.0), np.zeros(41)])
    edges = road_edges([box(0, 0, 40, 4)], [lane])

    # Both ends go, and the sides as far as they are within 3 m of where the lane leaves.
    np.testing.assert_allclose(length_m(edges), 2 * (40.0 - 2 * 2.0))
    assert all(abs(edge[:, 1] - 2).min() > 0.9 for edge in edges)


def test_an_outline_beside_a_lane_stays():
    lane = np.column_stack([np.linspace(5, 35, 31), np.full(31, 0.4), np.zeros(31)])

    np.testing.assert_allclose(length_m(road_edges([box(0, 0, 40, 4)], [lane])), 88.0)


def test_points_on_both_sides_of_an_outline():
    corners = np.array([(0.0, 0.0), (4, 0), (4, 4), (2, 1), (0, 4)])
    points_m = np.array([(1.0, 1), (2, 3), (2, 0.5), (5, 1), (3.5, 2.9)])

    assert inside(points_m, corners).tolist() == [True, False, True, False, True]


def test_a_line_is_made_dense_and_keeps_its_own_points():
    line_m = densify(np.array([(0.0, 0.0), (2.5, 0.0), (2.5, 1.0)]))

    np.testing.assert_allclose(line_m[:, 0], [0, 2.5 / 3, 5 / 3, 2.5, 2.5])
    np.testing.assert_allclose(resample(line_m, 3), [(0, 0), (1.75, 0), (2.5, 1)])


def test_kept_parts_are_joined_around_the_end_of_a_ring():
    ring = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    kept = np.array([True, False, True, True])

    (chain,) = kept_chains(ring, kept)
    assert chain.tolist() == [[1, 1], [0, 1], [0, 0], [1, 0]]
