import dataclasses

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.scene import AgentType
from infgen.tokens.agents import decode_tracks, match_agents
from infgen.tokens.grid import make_grid
from infgen.tokens.motion_tokens import make_match_table
from infgen.tokens.scene_tokens import (
    FIRST_MOTION_TOKEN,
    NO_CELL,
    NO_MOTION_TOKEN,
    Presence,
)
from infgen.tokens.tracks import read_paths

SETTINGS = TokenSettings()
GRID = make_grid(SETTINGS)


@pytest.fixture
def match(metre_moves):
    def run(scene, order="distance"):
        paths = read_paths(scene, SETTINGS)
        return match_agents(paths, make_match_table(metre_moves), GRID, order)

    return run


@pytest.fixture
def flickering(build_scene):
    """The ego, and a car 5 m beside it that is not known from step 18 to 47."""
    x_m = np.arange(91.0)
    path = np.stack([np.column_stack([x_m, 0 * x_m + y, 0 * x_m]) for y in (0, 5)])
    valid = np.ones((2, 91), bool)
    valid[1, 18:48] = False
    return build_scene(path, [0, 0], valid)


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_drive_the_codebook_can_write_is_written_exactly(match, drive, kind):
    matrix, _, _ = match(drive(speed_mps=10.0, kind=AgentType(kind)))

    np.testing.assert_array_equal(matrix.motion_token, [[FIRST_MOTION_TOKEN] + [5] * 17])
    np.testing.assert_allclose(matrix.pose[0, :, 0], 5.0 * np.arange(1, 19), atol=1e-4)


def test_errors_are_corrected_by_the_next_move_and_never_add_up(match, drive):
    matrix, _, _ = match(drive(speed_mps=9.0))  # 4.5 m: between two moves

    assert set(matrix.motion_token[0, 1:]) == {4, 5}
    error_m = matrix.pose[0, :, 0] - 4.5 * np.arange(1, 19)
    assert np.abs(error_m).max() <= 0.5 + 1e-4


def test_the_first_half_second_of_a_newcomer_is_swallowed(match, crossing):
    matrix, entries, _ = match(crossing())  # row 2 is known from step 30 on

    assert matrix.presence[2, 6] == Presence.INSERTED
    assert matrix.motion_token[2, 6] == FIRST_MOTION_TOKEN
    assert not matrix.observed[2, 6]
    assert (matrix.motion_token[2, :6] == NO_MOTION_TOKEN).all()
    np.testing.assert_allclose(matrix.pose[2, 6, :2], [22, 8 - 1.4 * 3.5], atol=1e-4)
    assert entries.token.tolist() == [0, 0, 0, 6]


def test_the_first_move_starts_where_the_agent_enters(match, crossing):
    matrix, _, _ = match(crossing(speed_mps=10.0))

    step_m = np.linalg.norm(np.diff(matrix.pose[1, :, :2], axis=0), axis=1)
    np.testing.assert_allclose(step_m, 5.0, atol=1e-4)


def test_the_ego_is_the_first_to_enter_in_either_order(match, crossing):
    for order in ("distance", "bearing"):
        _, entries, anchors = match(crossing(), order)

        assert entries.agent[0] == 0
        assert entries.cell[0] == GRID.ego_cell
        assert (anchors.agent[0], anchors.token[0]) == (0, 0)


def test_newcomers_enter_from_near_to_far_or_by_bearing(match, crossing):
    # At step 5 the ego is at (-35, 0). The car is 65 m away to its right, the cyclist
    # 73 m ahead to its left.
    _, near, _ = match(crossing(), "distance")
    _, swept, _ = match(crossing(), "bearing")

    assert near.agent.tolist() == [0, 1, 3, 2]
    assert swept.agent.tolist() == [0, 1, 3, 2]


def test_in_a_gap_an_agent_is_present_keeps_its_pose_and_has_no_move(match, flickering):
    matrix, _, _ = match(flickering)

    # Known at borders up to 15 and from 50 on: tokens 3 to 9 are not seen.
    assert (matrix.presence[1, 1:] == Presence.PRESENT).all()
    np.testing.assert_array_equal(matrix.observed[1], [0] + [1] * 2 + [0] * 7 + [1] * 8)
    np.testing.assert_array_equal(matrix.motion_token[1, 3:10], [NO_MOTION_TOKEN] * 7)
    np.testing.assert_array_equal(matrix.cell[1, 3:10], [NO_CELL] * 7)
    np.testing.assert_allclose(matrix.pose[1, 2:9, 0], 15.0, atol=1e-4)


def test_after_a_gap_the_chain_starts_anew_from_the_log(match, flickering):
    matrix, _, anchors = match(flickering)

    assert anchors.agent.tolist() == [0, 1]
    assert anchors.token.tolist() == [0, 9]
    np.testing.assert_allclose(anchors.pose[1], [50, 5, 0], atol=1e-4)
    np.testing.assert_array_equal(matrix.pose[1, 9], anchors.pose[1])
    np.testing.assert_allclose(matrix.pose[1, 10, 0], 55.0, atol=1e-4)


def test_cells_are_seen_from_the_egos_pose_at_the_same_token(match, crossing):
    matrix, entries, _ = match(crossing())

    assert (matrix.cell[0] == GRID.ego_cell).all()
    # The car is ahead of the ego's right: at token 7 both are 20 m from the corner.
    np.testing.assert_array_equal(GRID.centre_m[matrix.cell[1, 7]], [21, 0])
    np.testing.assert_array_equal(matrix.cell[entries.agent, entries.token], entries.cell)


def test_poses_of_the_absent_are_zero(match, crossing):
    matrix, _, _ = match(crossing())

    assert (matrix.pose[matrix.presence == Presence.ABSENT] == 0).all()


def test_decoded_tracks_run_along_the_moves_from_the_entering_pose_on(
    match, metre_moves, crossing
):
    matrix, _, _ = match(crossing(speed_mps=10.0))

    pose, known = decode_tracks(matrix, metre_moves)

    assert pose.shape == (4, 91, 3)
    np.testing.assert_array_equal(known[0], np.arange(91) >= 5)
    np.testing.assert_array_equal(known[2], np.arange(91) >= 35)
    np.testing.assert_array_equal(known[3], (np.arange(91) >= 5) & (np.arange(91) <= 60))
    np.testing.assert_allclose(pose[0, 5:, 0], -40 + np.arange(5, 91), atol=1e-4)
    assert (pose[~known] == 0).all()


def test_decoded_tracks_leave_gaps_open_and_end_tokens_at_their_poses(
    match, metre_moves, flickering
):
    matrix, _, _ = match(flickering)

    pose, known = decode_tracks(matrix, metre_moves)

    np.testing.assert_array_equal(np.flatnonzero(known[1]), [*range(5, 16), *range(50, 91)])
    ends = np.arange(5, 91, 5)
    shown = known[:, ends]
    np.testing.assert_allclose(pose[:, ends][shown], matrix.pose[shown], atol=1e-5)


def test_an_agent_of_a_single_token_enters_and_is_gone(match, build_scene):
    x_m = np.arange(91.0)
    path = np.stack([np.column_stack([x_m, 0 * x_m + y, 0 * x_m]) for y in (0, 5)])
    valid = np.ones((2, 91), bool)
    valid[1] = (np.arange(91) >= 5) & (np.arange(91) <= 12)

    matrix, entries, _ = match(build_scene(path, [0, 0], valid))

    states = [Presence.ABSENT, Presence.INSERTED, *[Presence.ABSENT] * 16]
    np.testing.assert_array_equal(matrix.presence[1], states)
    assert entries.token.tolist() == [0, 1]


def test_the_whole_matrix_turns_with_the_world(match, crossing):
    """Moves and entries are the same wherever a scene is and whichever way it faces."""
    scene = crossing()
    turn, shift = 0.7, np.float32([300, -120])
    tracks = scene.tracks
    cos, sin = np.cos(turn), np.sin(turn)
    turned = np.float32([[cos, -sin], [sin, cos]])
    xyz = tracks.xyz_m.copy()
    xyz[..., :2] = xyz[..., :2] @ turned.T + shift
    moved = dataclasses.replace(
        scene,
        tracks=dataclasses.replace(
            tracks,
            xyz_m=xyz,
            heading_rad=tracks.heading_rad + np.float32(turn),
            velocity_mps=tracks.velocity_mps @ turned.T,
        ),
    )

    (here, entries, _), (there, others, _) = match(scene), match(moved)

    np.testing.assert_array_equal(here.motion_token, there.motion_token)
    np.testing.assert_array_equal(here.presence, there.presence)
    np.testing.assert_allclose(entries.offset_m, others.offset_m, atol=1e-3)
