import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.rollout.population import (
    EGO_ROW,
    NO_AGENT,
    InsertedAgents,
    add_inserted,
    advance_agents,
    insertion_pose,
    place_logged_agents,
    remove_beyond,
)
from infgen.scene import AgentType
from infgen.tokens.grid import make_grid
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)

PRESENT, REMOVED = Presence.PRESENT, Presence.REMOVED


def inserted(who, cell, heading=60, offset_m=(0.0, 0.0)):
    count, grid = len(who), make_grid(TokenSettings())
    position_m = grid.centre_m[cell] + np.array(offset_m, dtype=np.float32)
    return InsertedAgents(
        who=np.array(who),
        position_m=np.tile(position_m, (count, 1)),
        turned_rad=np.full(count, grid.heading_centre_rad[heading]),
        agent_type=np.full(count, AgentType.CYCLIST, dtype=np.int8),
        size_lwh_m=np.tile(np.array([2.0, 1.0, 1.7], dtype=np.float32), (count, 1)),
    )


def test_the_ego_sits_in_row_zero_and_the_others_from_near_to_far(parked, start):
    scene = parked(3, ego=2)  # cars at x = 0, 8, 16, 24; the ego is the one at 16

    now = place_logged_agents([start(scene)], min_rows=6)[-1]

    np.testing.assert_allclose(now.pose[0, :4, 0], [16, 8, 24, 0], atol=1e-4)
    np.testing.assert_array_equal(now.agent_number[0], [2, 1, 3, 0, NO_AGENT, NO_AGENT])
    assert now.num_agents_so_far[0] == 4


def test_the_history_ends_at_the_logs_own_poses(drive, start):
    scene = drive(speed_mps=9.0)  # 4.5 m per half second: between two moves

    now = place_logged_agents([start(scene)], min_rows=1)[-1]

    np.testing.assert_allclose(now.pose[0, 0], scene.tracks.pose(scene.now)[0])


def test_others_are_counted_within_a_radius_of_the_ego(parked, start):
    here, there = parked(3, ego=2), parked(5)  # others at -16, -8, 8; at 8, 16, 24, 32, 40

    now = place_logged_agents([start(here), start(there)], min_rows=9)[-1]

    np.testing.assert_array_equal(now.count_others(9.0), [2, 1])
    np.testing.assert_array_equal(now.count_others(17.0), [3, 2])


def test_rows_that_are_free_in_every_rollout_are_cut_off(parked, start):
    wide = place_logged_agents([start(parked(3)), start(parked(5))], min_rows=9)[-1]

    narrow = wide.without_free_rows()

    assert narrow.agent_number.shape == (2, 6)
    np.testing.assert_array_equal(narrow.pose, wide.pose[:, :6])
    np.testing.assert_array_equal(narrow.num_agents_so_far, wide.num_agents_so_far)
    assert narrow.without_free_rows().agent_number.shape == (2, 6)
    assert narrow.take(np.array([0])).without_free_rows().agent_number.shape == (1, 4)


def test_rows_grow_with_the_largest_history(parked, start):
    history = place_logged_agents([start(parked(3)), start(parked(5))], min_rows=2)

    assert len(history) == 2
    assert history[0].agent_number.shape == (2, 6)


def test_histories_of_two_lengths_do_not_mix(parked, start):
    with pytest.raises(ValueError, match="one length"):
        place_logged_agents([start(parked(1)), start(parked(1, now=15))], min_rows=2)


def test_everyone_moves_by_the_move_of_their_row(parked, start, metre_moves):
    population = place_logged_agents([start(parked(1))], min_rows=3)[-1]
    motion_token = np.array([[5, 10, 20]])

    after, path = advance_agents(
        population, motion_token, np.zeros((1, 3), bool), metre_moves
    )

    np.testing.assert_allclose(after.pose[0, :2, 0], [5, 18], atol=1e-4)
    np.testing.assert_allclose(path[0, 0, :, 0], [1, 2, 3, 4, 5], atol=1e-4)
    np.testing.assert_array_equal(after.motion_token[0], [5, 10, NO_MOTION_TOKEN])
    np.testing.assert_array_equal(after.pose[0, 2], 0)


def test_whoever_leaves_is_there_once_more_and_then_gone_for_good(
    parked, start, metre_moves, nobody
):
    population = place_logged_agents([start(parked(1))], min_rows=2)[-1]
    motion_token, _ = nobody(1, 2)
    leave = np.array([[False, True]])

    removed, path = advance_agents(population, motion_token, leave, metre_moves)
    gone, after = advance_agents(removed, motion_token, leave, metre_moves)

    np.testing.assert_array_equal(removed.presence[0], [PRESENT, REMOVED])
    assert path[0, 1].any()
    assert gone.agent_number[0, 1] == NO_AGENT
    assert gone.presence[0, 1] == Presence.ABSENT
    assert not after[0, 1].any()


def test_the_ego_never_leaves(parked, start, metre_moves):
    population = place_logged_agents([start(parked(1))], min_rows=2)[-1]

    after, _ = advance_agents(
        population, np.zeros((1, 2), int), np.ones((1, 2), bool), metre_moves
    )

    assert after.presence[0, EGO_ROW] == PRESENT


def test_whoever_crosses_the_circle_outwards_leaves_and_who_was_outside_stays(
    parked, start, metre_moves
):
    # Cars 8, 16 and 24 m ahead of the ego, which stands; each drives 5 m on.
    before = place_logged_agents([start(parked(3))], min_rows=5)[-1]
    moved, _ = advance_agents(
        before, np.array([[0, 5, 5, 5, 0]]), np.zeros((1, 5), bool), metre_moves
    )

    after = remove_beyond(before, moved, 18.0)

    np.testing.assert_array_equal(
        after.presence[0], [PRESENT, PRESENT, REMOVED, PRESENT, 0]
    )
    np.testing.assert_array_equal(moved.presence[0, 1:4], PRESENT)


def test_a_newcomer_takes_the_first_free_row_with_a_life_of_its_own(parked, start, grid):
    population = place_logged_agents([start(parked(1)), start(parked(2))], min_rows=4)[-1]

    after, row = add_inserted(population, inserted([True, False], grid.ego_cell - 5))

    np.testing.assert_array_equal(row, [2, -1])
    np.testing.assert_array_equal(after.agent_number[0], [0, 1, 2, NO_AGENT])
    np.testing.assert_array_equal(after.num_agents_so_far, [3, 3])
    assert after.presence[0, 2] == Presence.INSERTED
    assert after.motion_token[0, 2] == FIRST_MOTION_TOKEN
    assert not after.observed[0, 2]
    assert population.agent_number[0, 2] == NO_AGENT, (
        "the population it came from stays as it was"
    )


def test_a_freed_row_is_used_again_by_another_life(
    parked, start, metre_moves, grid, nobody
):
    population = place_logged_agents([start(parked(1))], min_rows=2)[-1]
    motion_token, stay = nobody(1, 2)
    removed, _ = advance_agents(
        population, motion_token, np.array([[False, True]]), metre_moves
    )
    gone, _ = advance_agents(removed, motion_token, stay, metre_moves)

    after, row = add_inserted(gone, inserted([True], grid.ego_cell - 5))

    assert row[0] == 1
    assert after.agent_number[0, 1] == 2


def test_a_full_rollout_turns_newcomers_away(parked, start, grid):
    population = place_logged_agents([start(parked(1))], min_rows=2)[-1]

    after, row = add_inserted(population, inserted([True], grid.ego_cell - 5))

    assert row[0] == -1
    np.testing.assert_array_equal(after.agent_number, population.agent_number)


@pytest.mark.parametrize(
    ("heading_rad", "expected"),
    [(0.0, (1.0, -9.0)), (np.pi / 2, (9.0, 1.0)), (np.pi, (-1.0, 9.0))],
)
def test_a_cell_to_the_egos_right_is_to_its_right_whichever_way_it_faces(
    grid, heading_rad, expected
):
    # Three cells to the right of the ego, and one metre ahead within the cell.
    ego = np.array([[0.0, 0.0, heading_rad]], dtype=np.float32)

    pose = insertion_pose(ego, inserted([True], grid.ego_cell + 3, offset_m=(0.0, 1.0)))

    np.testing.assert_allclose(pose[0, :2], expected, atol=1e-4)


def test_cells_tell_where_everyone_is_around_the_ego(parked, start, grid):
    population = place_logged_agents([start(parked(1))], min_rows=3)[
        -1
    ]  # 8 m ahead, 2 m to the right

    cells = population.cells(grid)

    assert cells[0, 0] == grid.ego_cell
    np.testing.assert_allclose(grid.centre_m[cells[0, 1]], [3, 9])
    assert cells[0, 2] == NO_CELL
