import numpy as np
import pytest

from infgen.views.scene.interpolation import ego_place, moment_at
from infgen.views.scene.style import AGENTS
from infgen.views.scene.view_model import show_log, show_rollout
from tests.exports.replays import replay, with_newcomer


def test_between_two_steps_agents_are_between_their_places(drive):
    moment = moment_at(show_log(drive(speed_mps=10.0)), 20.25)

    np.testing.assert_allclose(moment.pose[0], [20.25, 0, 0], atol=1e-4)
    assert moment.alpha.tolist() == [1.0]


def test_a_turn_through_west_takes_the_short_way(drive):
    scene = drive(speed_mps=0.0)
    scene.tracks.heading_rad[0, ::2] = np.pi - 0.1
    scene.tracks.heading_rad[0, 1::2] = -np.pi + 0.1

    (pose,) = moment_at(show_log(scene), 10.5).pose

    assert abs(abs(pose[2]) - np.pi) < 1e-4


def test_who_leaves_fades_then_leaves_an_outline_and_is_gone(crossing):
    shown = show_log(crossing())  # Row 3 is there until step 60.
    times = (50.0, 55.0, 60.0, 63.5, 67.5)
    alpha, ghost = (
        [getattr(moment_at(shown, time), name)[3] for time in times]
        for name in ("alpha", "ghost")
    )

    assert ghost == [False, False, False, True, False]
    assert alpha[0] == 1.0
    assert alpha[1] == pytest.approx((1 + AGENTS.leaving_alpha) / 2)
    assert alpha[2] == AGENTS.leaving_alpha
    assert alpha[3] == pytest.approx(AGENTS.leaving_alpha / 2)
    assert alpha[4] == 0.0


def test_whoever_left_an_outline_left_it_where_it_was_last(crossing):
    shown = show_log(crossing())

    np.testing.assert_array_equal(moment_at(shown, 63.5).pose[3], shown.pose[3, 60])


def test_a_newcomer_grows_visible(crossing):
    shown = show_rollout(with_newcomer(replay(crossing()), 40))
    alphas = [moment_at(shown, time).alpha[-1] for time in (40.9, 41.0, 42.0, 45.0)]

    assert alphas == [0.0, AGENTS.arrive_alpha, AGENTS.arrive_alpha + 0.25, 1.0]


def test_after_the_end_all_stand_still(drive):
    shown = show_log(drive(speed_mps=10.0))

    np.testing.assert_array_equal(moment_at(shown, 500.0).pose, shown.pose[:, -1])


def test_who_is_lost_for_a_while_is_not_seen_but_has_not_left(build_scene):
    path = np.zeros((1, 20, 3))
    valid = np.ones((1, 20), bool)
    valid[0, 5:8] = False
    shown = show_log(build_scene(path, [0], valid, now=2))

    assert [moment_at(shown, time).alpha[0] for time in (4.0, 5.0, 7.0, 8.0)] == [
        1,
        0,
        0,
        1,
    ]


def test_the_camera_stays_where_the_ego_was_last_seen(crossing):
    shown = show_log(crossing(ego=3))

    np.testing.assert_allclose(ego_place(shown, 80.0), shown.pose[3, 60, :2])
    np.testing.assert_allclose(
        ego_place(shown, 30.5), shown.pose[3, 30:32, :2].mean(axis=0)
    )


def test_before_the_ego_is_seen_the_camera_waits_for_it(crossing):
    shown = show_log(crossing(ego=2))  # Seen from step 30 on.

    np.testing.assert_allclose(ego_place(shown, 3.0), shown.pose[2, 30, :2])
