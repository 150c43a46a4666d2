import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from infgen.geometry import box_corners, to_local
from infgen.scene import AgentType
from infgen.tokens.motion_tokens import (
    advance,
    follow,
    make_match_table,
    nearest_motion_tokens,
    ranked_motion_tokens,
)
from infgen.tokens.vocabulary import BOX_LW_M, MotionVocabulary


def random_codebook(rng, moves=200, spread=(8.0, 1.0, 0.6)):
    end = rng.normal(size=(3, moves, 3)) * spread
    end[:, 0] = 0
    end[:, moves // 2] = end[:, 1]  # twins
    path = end[:, :, None] * np.linspace(0, 1, 6)[:, None]
    real = np.ones((3, moves), bool)
    return MotionVocabulary(BOX_LW_M, path.astype(np.float32), real)


def measure_them_all(target, pose, kind, vocabulary):
    """The nearest move by its definition: every corner of every move."""
    wanted = to_local(target, pose).astype(np.float64)
    size = vocabulary.size_lw_m.astype(np.float64)
    corners = box_corners(vocabulary.end_pose.astype(np.float64), size[:, None])
    aim = box_corners(wanted, size[kind])
    gap = np.linalg.norm(corners[kind] - aim[:, None], axis=-1).mean(axis=-1)
    return gap


@given(
    st.integers(0, 2**32),
    st.sampled_from([0.01, 0.3, 3.0, 300.0]),
    st.sampled_from([0.0, 30.0, 5000.0]),
)
@example(0, 300.0, 5000.0)
@settings(deadline=None)
def test_the_nearest_move_is_the_one_that_measuring_all_corners_finds(seed, stray, far):
    rng = np.random.default_rng(seed)
    vocabulary = random_codebook(rng)
    rows = 40
    kind = rng.integers(0, 3, rows).astype(np.int8)
    pose = (rng.normal(size=(rows, 3)) * [far, far, 1]).astype(np.float32)
    ahead = advance(pose, kind, rng.integers(0, 200, rows).astype(np.int16), vocabulary)
    target = ahead + (rng.normal(size=(rows, 3)) * stray).astype(np.float32)
    target[:, 2] = (target[:, 2] + np.pi) % (2 * np.pi) - np.pi

    found = nearest_motion_tokens(target, pose, kind, make_match_table(vocabulary))

    gap_m = measure_them_all(target, pose, kind, vocabulary)
    np.testing.assert_array_equal(found, gap_m.argmin(axis=1))


@given(
    st.integers(0, 2**32),
    st.sampled_from([1, 2, 5, 40, 200]),
    st.sampled_from([0.01, 3.0, 300.0]),
)
@settings(deadline=None)
def test_the_token_of_a_rank_is_the_one_that_measuring_all_corners_finds(
    seed, count, stray
):
    rng = np.random.default_rng(seed)
    vocabulary = random_codebook(rng)
    rows = 20
    kind = rng.integers(0, 3, rows).astype(np.int8)
    pose = (rng.normal(size=(rows, 3)) * [30, 30, 1]).astype(np.float32)
    ahead = advance(pose, kind, rng.integers(0, 200, rows).astype(np.int16), vocabulary)
    target = ahead + (rng.normal(size=(rows, 3)) * stray).astype(np.float32)

    rank = rng.integers(0, count, rows)
    table = make_match_table(vocabulary)
    nearest, ranked = ranked_motion_tokens(target, pose, kind, rank, table)

    gap_m = measure_them_all(target, pose, kind, vocabulary)
    in_order = np.argsort(gap_m, axis=1, kind="stable")
    np.testing.assert_array_equal(nearest, in_order[:, 0])
    np.testing.assert_array_equal(ranked, in_order[np.arange(rows), rank])


def test_tokens_of_different_ranks_differ():
    rng = np.random.default_rng(3)
    table = make_match_table(random_codebook(rng))
    target = rng.normal(size=(50, 3)).astype(np.float32)
    pose, kind = np.zeros_like(target), rng.integers(0, 3, 50).astype(np.int8)

    few = np.column_stack(
        [
            ranked_motion_tokens(target, pose, kind, np.full(50, rank), table)[1]
            for rank in range(7)
        ]
    )

    np.testing.assert_array_equal(
        few[:, 0], nearest_motion_tokens(target, pose, kind, table)
    )
    assert all(len(set(row)) == 7 for row in few.tolist())


def test_of_twins_the_first_is_chosen():
    vocabulary = random_codebook(np.random.default_rng(1))
    pose, kind = np.zeros((1, 3), np.float32), np.int8([0])
    target = advance(pose, kind, np.int16([100]), vocabulary)

    assert nearest_motion_tokens(target, pose, kind, make_match_table(vocabulary)) == [1]


def test_many_rows_give_what_each_gives_alone():
    rng = np.random.default_rng(2)
    table = make_match_table(random_codebook(rng))
    target = rng.normal(size=(9000, 3)).astype(np.float32)
    pose, kind = np.zeros_like(target), np.zeros(9000, np.int8)

    together = nearest_motion_tokens(target, pose, kind, table)

    some = [0, 4095, 4096, 8999]
    alone = [
        nearest_motion_tokens(target[[i]], pose[[i]], kind[[i]], table)[0] for i in some
    ]
    np.testing.assert_array_equal(together[some], alone)


def test_nobody_has_no_moves(metre_moves):
    nobody = np.empty((0, 3), np.float32)

    assert (
        len(
            nearest_motion_tokens(
                nobody, nobody, np.empty(0, np.int8), make_match_table(metre_moves)
            )
        )
        == 0
    )


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_boxes_are_compared_at_each_kinds_own_size(kind):
    # One move is 0.3 m off, the other turned by 0.3 rad: the turn moves the corners of a
    # car's box (half diagonal 2.6 m) by 0.78 m, of a cyclist's (1.1 m) by 0.33 m, of a
    # pedestrian's (0.7 m) by 0.21 m.
    ends = np.float32([[0, 0, 0], [1.3, 0, 0], [1, 0, 0.3]])
    path = np.broadcast_to(ends[:, None] * np.linspace(0, 1, 6)[:, None], (3, 3, 6, 3))
    vocabulary = MotionVocabulary(BOX_LW_M, path.astype(np.float32), np.ones((3, 3), bool))
    target = np.float32([[1, 0, 0]])

    found = nearest_motion_tokens(
        target, 0 * target, np.int8([kind]), make_match_table(vocabulary)
    )

    assert found[0] == (2 if kind == AgentType.PEDESTRIAN else 1)


def test_an_agent_without_a_move_stays(metre_moves):
    pose = np.float32([[1, 2, np.pi / 2], [1, 2, np.pi / 2]])

    moved = advance(pose, np.int8([0, 1]), np.int16([-1, 3]), metre_moves)

    np.testing.assert_allclose(moved[:, :2], [[1, 2], [1, 5]], atol=1e-5)


def test_an_agent_driven_from_outside_is_followed_and_errors_do_not_add_up(metre_moves):
    table, kind = make_match_table(metre_moves), np.int8([0])
    pose, chosen = np.zeros((1, 3), np.float32), []

    for token in range(1, 21):
        target = np.float32([[4.5 * token, 0, 0]])  # between two moves
        move, pose = follow(target, pose, kind, table)
        chosen.append(move[0])
        assert abs(pose[0, 0] - target[0, 0]) <= 0.5 + 1e-4

    assert set(chosen) == {4, 5}
