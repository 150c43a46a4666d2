import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.config import TokenSettings
from infgen.tokens.grid import make_grid
from infgen.tokens.insertion import (
    decode_insertions,
    encode_insertions,
    insertion_order,
    join_insertions,
)
from infgen.tokens.scene_tokens import NO_CELL

GRID = make_grid(TokenSettings())
EGO = np.float32([100, 50, np.pi / 2])  # facing north


def encode(*poses, token=3, ego=EGO):
    pose = np.float32(poses)
    return encode_insertions(token, np.arange(len(pose)), pose, ego, GRID)


def test_a_newcomer_is_a_cell_a_bin_and_what_they_leave_out():
    # 9 m to the right and 30.5 m ahead of an ego that faces north, itself facing east.
    entry = encode((109, 80.5, 0))

    assert GRID.centre_m[entry.cell[0]].tolist() == [9, 30]
    np.testing.assert_allclose(entry.offset_m, [[0, 0.5]], atol=1e-4)
    assert entry.heading[0] == 30  # -90 degrees, 30 bins from straight behind
    np.testing.assert_allclose(np.rad2deg(entry.residual_rad), [-1.5], atol=1e-3)
    assert entry.token.tolist() == [3]


def test_beyond_the_grid_the_offset_is_the_whole_way():
    entry = encode((100, 150, np.pi / 2))

    assert entry.cell[0] == NO_CELL
    np.testing.assert_allclose(entry.offset_m, [[0, 100]], atol=1e-4)
    np.testing.assert_allclose(
        decode_insertions(entry, EGO, GRID), [[100, 150, np.pi / 2]], atol=1e-4
    )


@given(
    arrays(np.float32, (6, 3), elements=st.floats(-140, 140, width=32)),
    arrays(np.float32, 3, elements=st.floats(-3, 3, width=32)),
)
def test_entries_decode_to_the_pose_they_were_made_from(pose, ego):
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi

    decoded = decode_insertions(encode(*pose, ego=ego), ego, GRID)

    np.testing.assert_allclose(decoded[:, :2], pose[:, :2], atol=1e-4)
    turn = decoded[:, 2] - pose[:, 2]
    np.testing.assert_allclose(np.abs(np.exp(1j * turn) - 1), 0, atol=1e-5)


def test_newcomers_are_ordered_from_near_to_far():
    pose = np.float32([[100, 90, 0], [100, 40, 0], [120, 50, 0]])  # 40, 10, 20 m

    assert insertion_order(pose, EGO, "distance").tolist() == [1, 2, 0]


def test_equally_near_newcomers_keep_the_order_of_the_log():
    pose = np.float32([[100, 60, 0], [110, 50, 0], [100, 40, 0]])

    assert insertion_order(pose, EGO, "distance").tolist() == [0, 1, 2]


def test_bearing_sweeps_from_behind_over_the_right_and_the_front_to_the_left():
    left, front, right = (90, 50, 0), (100, 60, 0), (110, 50, 0)
    behind_right = (101, 40, 0)

    order = insertion_order(np.float32([left, front, right, behind_right]), EGO, "bearing")

    assert order.tolist() == [3, 2, 1, 0]


def test_newcomers_of_one_token_are_found_again():
    joined = join_insertions(
        [encode((1, 2, 0), token=0), encode((3, 4, 0), (5, 6, 0), token=2)]
    )

    assert len(joined.at(1).agent) == 0
    assert joined.at(2).agent.tolist() == [0, 1]
    np.testing.assert_array_equal(joined.at(2).offset_m, joined.offset_m[1:])
