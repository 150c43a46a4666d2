import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.config import TokenSettings
from infgen.errors import ConfigError
from infgen.tokens.grid import (
    decode_cell,
    decode_heading,
    decode_offset,
    encode_cell,
    encode_heading,
    encode_offset,
    from_grid,
    make_grid,
    to_grid,
)
from infgen.tokens.scene_tokens import NO_CELL

GRID = make_grid(TokenSettings())
POINTS = arrays(np.float32, (7, 2), elements=st.floats(-90, 90, width=32))


def f32(*values):
    return np.array(values, dtype=np.float32)


def test_75_m_in_steps_of_3_m_hold_1961_cells_and_the_ego_is_in_the_middle_one():
    assert GRID.num_cells == 1961
    assert GRID.ego_cell == 980
    np.testing.assert_array_equal(GRID.centre_m[980], [0, 0])


@pytest.mark.parametrize(
    ("radius_m", "step_m", "cells"), [(3.0, 3.0, 5), (4.3, 3.0, 9), (72.0, 3.0, 1793)]
)
def test_the_number_of_cells_follows_from_radius_and_step(radius_m, step_m, cells):
    settings = TokenSettings(grid_radius_m=radius_m, grid_cell_m=step_m)

    assert make_grid(settings).num_cells == cells


def test_cells_run_row_by_row_from_the_front_and_from_left_to_right():
    grid = make_grid(TokenSettings(grid_radius_m=3.0, grid_cell_m=3.0))

    expected = [[0, 3], [-3, 0], [0, 0], [3, 0], [0, -3]]
    np.testing.assert_array_equal(grid.centre_m, expected)
    rows = GRID.centre_m[:, 1]
    assert rows[0] == 75
    assert rows[-1] == -75
    assert (np.diff(rows) <= 0).all()


def test_the_ego_faces_up_the_grid_and_has_its_right_side_at_plus_x():
    ego = f32(10, 20, np.pi / 2)  # facing north

    ahead, right = to_grid(f32(10, 25)[None], ego), to_grid(f32(14, 20)[None], ego)

    np.testing.assert_allclose(ahead, [[0, 5]], atol=1e-5)
    np.testing.assert_allclose(right, [[4, 0]], atol=1e-5)


@given(POINTS, st.floats(-3, 3, width=32))
def test_grid_frame_and_world_are_inverse(xy_m, heading):
    ego = f32(100, -50, heading)

    np.testing.assert_allclose(to_grid(from_grid(xy_m, ego), ego), xy_m, atol=1e-4)


@given(POINTS)
def test_the_cell_is_the_nearest_of_all_and_none_beyond_the_radius(xy_m):
    cell = encode_cell(xy_m, GRID)

    distance_m = np.hypot(xy_m[:, 0], xy_m[:, 1])
    np.testing.assert_array_equal(cell == NO_CELL, distance_m > 75)
    inside = cell != NO_CELL
    gap_m = np.linalg.norm(xy_m[:, None].astype(float) - GRID.centre_m, axis=-1)
    chosen_m = np.take_along_axis(gap_m, np.maximum(cell, 0)[:, None].astype(int), 1)[:, 0]
    np.testing.assert_allclose(chosen_m[inside], gap_m.min(axis=1)[inside], atol=1e-5)


@given(arrays(np.float32, (20, 2), elements=st.floats(-52, 52, width=32)))
def test_a_point_off_the_rim_is_at_most_half_a_step_from_its_centre_either_way(xy_m):
    inner = xy_m[np.hypot(xy_m[:, 0], xy_m[:, 1]) < 72]

    offset_m = inner - decode_cell(encode_cell(inner, GRID), GRID)

    assert (np.abs(offset_m) <= 1.5 + 1e-5).all()


def test_points_of_the_rim_whose_square_is_outside_go_to_the_nearest_cell_inside():
    # (54, 54) is 76.4 m away; the point itself is 74.96 m away.
    assert encode_cell(f32(53, 53)[None], GRID)[0] != NO_CELL


@pytest.mark.parametrize(("radius_m", "step_m"), [(75.0, 3.0), (51.2, 2.0), (4.3, 3.0)])
def test_the_cell_of_a_point_at_the_rim_is_the_first_of_the_nearest(radius_m, step_m):
    grid = make_grid(TokenSettings(grid_radius_m=radius_m, grid_cell_m=step_m))
    random = np.random.default_rng(0)
    turn = random.uniform(-np.pi, np.pi, 2000)
    away_m = radius_m - step_m * random.uniform(0, 1.5, 2000)
    xy_m = (away_m * np.stack([np.cos(turn), np.sin(turn)])).T.astype(np.float32)
    cell = encode_cell(xy_m, grid)

    gap_m = np.linalg.norm(xy_m[:, None] - grid.centre_m, axis=-1)
    np.testing.assert_array_equal(gap_m[np.arange(2000), cell], gap_m.min(axis=1))


def test_every_centre_is_in_its_own_cell():
    cells = np.arange(1961, dtype=np.int16)

    np.testing.assert_array_equal(encode_cell(decode_cell(cells, GRID), GRID), cells)


def test_no_cell_decodes_to_the_ego_itself():
    np.testing.assert_array_equal(decode_cell(np.int16([NO_CELL]), GRID), [[0, 0]])


@pytest.mark.parametrize(
    ("relative_deg", "heading"),
    [(-180, 0), (-177.1, 0), (-176.9, 1), (1, 60), (179.9, 119)],
)
def test_heading_bins_count_from_straight_behind(relative_deg, heading):
    assert encode_heading(f32(np.deg2rad(relative_deg)), GRID)[0] == heading


def test_a_bin_decodes_to_its_middle():
    middle_deg = np.rad2deg(decode_heading(np.int16([0, 60, 119]), GRID))

    np.testing.assert_allclose(middle_deg, [-178.5, 1.5, 178.5], atol=1e-4)


@given(arrays(np.float32, 9, elements=st.floats(-7, 7, width=32)))
def test_no_heading_is_farther_than_half_a_bin_from_its_bins_middle(relative_rad):
    error = decode_heading(encode_heading(relative_rad, GRID), GRID) - relative_rad
    wrapped = (error + np.pi) % (2 * np.pi) - np.pi

    assert np.abs(np.rad2deg(wrapped)).max() <= 1.5 + 1e-3


def test_a_grid_too_fine_to_be_numbered_is_refused():
    with pytest.raises(ConfigError, match="too many cells"):
        make_grid(dataclasses.replace(TokenSettings(), grid_cell_m=0.5))


@given(arrays(np.float32, (20, 2), elements=st.floats(-1.5, 1.5, width=32)))
def test_an_offset_is_at_most_half_a_bin_from_the_middle_of_its_own(offset_m):
    found_m = decode_offset(encode_offset(offset_m, GRID), GRID)

    assert (np.abs(found_m - offset_m) <= GRID.offset_step_m / 2 + 1e-6).all()


def test_offset_bins_are_numbered_row_by_row_from_the_rear_and_decoding_is_the_inverse():
    bins = np.arange(len(GRID.offset_m)).astype(np.int16)

    np.testing.assert_array_equal(encode_offset(decode_offset(bins, GRID), GRID), bins)
    assert len(bins) == 144
    first_m = decode_offset(bins[[0, 1, 12]], GRID)
    np.testing.assert_allclose(
        first_m, [[-1.375, -1.375], [-1.125, -1.375], [-1.375, -1.125]]
    )


def test_an_offset_beyond_its_cell_gets_the_nearest_bin():
    found = encode_offset(f32(9.0, 0.1)[None], GRID)

    np.testing.assert_allclose(decode_offset(found, GRID), [[1.375, 0.125]])
