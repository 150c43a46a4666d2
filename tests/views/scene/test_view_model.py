from dataclasses import replace

import numpy as np
import pytest

from infgen.views.scene.view_model import (
    Role,
    ViewModel,
    make_view_model,
    show_log,
    show_rollout,
)
from tests.exports.replays import replay, with_newcomer


def test_in_the_log_who_is_first_seen_after_now_came_in_later(crossing):
    shown = show_log(crossing())

    assert shown.role.tolist() == [Role.EGO, Role.INITIAL, Role.INSERTED, Role.INITIAL]
    assert shown.first_step.tolist() == [0, 0, 30, 0]


def test_who_is_there_at_the_end_has_not_left(crossing):
    shown = show_log(crossing())

    assert shown.last_step.tolist() == [91, 91, 91, 60]


def test_in_a_rollout_who_was_inserted_came_in_later(crossing):
    shown = show_rollout(with_newcomer(replay(crossing()), 40))

    assert shown.role.tolist() == [Role.EGO, Role.INITIAL, Role.INITIAL, Role.INSERTED]
    assert shown.first_step.tolist() == [0, 0, 0, 41]
    assert shown.name == "rollout 0"


def test_who_is_never_there_is_left_out_and_the_ego_is_found_again(crossing):
    scene = crossing(ego=3)
    valid = scene.tracks.valid.copy()
    valid[1] = False
    scene = replace(scene, tracks=replace(scene.tracks, valid=valid))

    shown = show_log(scene)

    assert shown.id.tolist() == [100, 102, 103]
    assert shown.id[shown.ego] == 103


def test_a_box_has_the_mean_of_its_logged_sizes(drive):
    scene = drive()
    size = scene.tracks.size_lwh_m.copy()
    size[0, ::2, 0] += 1.0
    size[0, 0, 0] = 1000.0
    valid = scene.tracks.valid.copy()
    valid[0, 0] = False
    tracks = replace(scene.tracks, size_lwh_m=size, valid=valid)

    (length_m, _), *_ = show_log(replace(scene, tracks=tracks)).size_lw_m

    assert length_m == pytest.approx(4.8 + 0.5)


def test_a_film_holds_the_log_and_then_the_rollouts(crossing):
    scene = crossing()
    view_model = make_view_model(scene, (replay(scene, 0), replay(scene, 5)))

    assert [showing.name for showing in view_model.showings] == [
        "log",
        "rollout 0",
        "rollout 5",
    ]
    assert view_model.num_steps == 91


def test_a_rollout_of_another_scene_is_refused(crossing):
    other = replace(replay(crossing()), scenario_id="other")

    with pytest.raises(
        ValueError, match="rollout 0 is of scene other, not of made-by-hand"
    ):
        make_view_model(crossing(), (other,))


def test_a_film_without_a_picture_is_refused(crossing):
    with pytest.raises(ValueError, match="nothing to show of scene made-by-hand"):
        make_view_model(crossing(), (), log=False)


def test_a_film_may_be_of_rollouts_alone(crossing):
    view_model = make_view_model(crossing(), (replay(crossing()),), log=False)

    assert isinstance(view_model, ViewModel)
    assert np.array_equal(
        view_model.showings[0].pose[..., :2], replay(crossing()).xyz_m[..., :2]
    )
