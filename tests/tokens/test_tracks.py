import dataclasses

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.scene import AgentType
from infgen.tokens.tracks import TokensError, clean_headings, read_paths

SETTINGS = TokenSettings()
CAR, WALKER, OTHER = AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.OTHER


def line(start_xy_m=(0.0, 0.0), velocity_mps=(10.0, 0.0), steps=91, heading_rad=0.0):
    """Poses [step, 3] at constant velocity."""
    at_s = 0.1 * np.arange(steps)[:, None]
    xy_m = np.array(start_xy_m) + at_s * np.array(velocity_mps)
    return np.column_stack([xy_m, np.full(steps, heading_rad)])


def shown(steps, *spans):
    """Validity [step] of an agent known in ``range(*span)`` only."""
    valid = np.zeros(steps, bool)
    for first, end in spans:
        valid[first:end] = True
    return valid


@pytest.fixture
def beside_ego(build_scene):
    """A scene with the ego and one car 5 m beside it, known at the steps of some spans."""

    def build(*spans, steps=91, **more):
        valid = np.stack([np.ones(steps, bool), shown(steps, *spans)])
        path = np.stack([line(steps=steps), line((0, 5), steps=steps)])
        return build_scene(path, [CAR, CAR], valid, **more)

    return build


def tokens_of(scene, settings=SETTINGS, row=1, **more):
    """The tokens with the agent known at both ends."""
    valid = read_paths(scene, settings, **more).valid[row]
    return np.flatnonzero(valid[:-1] & valid[1:]).tolist()


def test_poses_are_those_of_the_log_at_every_fifth_step(drive):
    paths = read_paths(drive(speed_mps=10.0), SETTINGS)

    np.testing.assert_allclose(paths.pose[0, :, 0], 5.0 * np.arange(19), atol=1e-4)
    assert paths.valid.all()


@pytest.mark.parametrize(
    ("first", "token"),
    [(0, 0), (1, 0), (4, 0), (5, 1), (6, 1), (9, 1), (10, 1), (11, 2), (14, 2), (15, 3)],
)
def test_first_known_step_and_first_token(beside_ego, first, token):
    """The table of SPEC 1.6, the special case of step 10 included."""
    assert tokens_of(beside_ego((first, 91)))[0] == token


def test_an_agent_that_appears_is_drawn_back_to_the_tokens_start_at_its_velocity(
    beside_ego,
):
    paths = read_paths(beside_ego((23, 91)), SETTINGS)

    np.testing.assert_allclose(paths.pose[1, 4], [20.0, 5.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(paths.pose[1, 5], [25.0, 5.0, 0.0], atol=1e-4)


@pytest.mark.parametrize(
    ("missing", "tokens"),
    [
        pytest.param((20, 30), list(range(18)), id="ten steps, one second, are filled"),
        pytest.param((20, 31), [0, 1, 2, *range(7, 18)], id="eleven are not"),
        pytest.param((22, 24), list(range(18)), id="a flicker"),
    ],
)
def test_short_gaps_are_filled_and_long_ones_stay(beside_ego, missing, tokens):
    first, end = missing

    assert tokens_of(beside_ego((0, first), (end, 91))) == tokens


def test_gaps_are_filled_along_a_straight_line_and_the_short_way_round(build_scene):
    path = np.stack([line(), line((0, 5))])
    path[1, :25, 2], path[1, 25:, 2] = np.deg2rad(170), np.deg2rad(-170)
    valid = np.ones((2, 91), bool)
    valid[1, 21:30] = False  # known at 20 and 30

    paths = read_paths(build_scene(path, [CAR, CAR], valid), SETTINGS)

    np.testing.assert_allclose(paths.pose[1, 5, :2], [25.0, 5.0], atol=1e-4)
    np.testing.assert_allclose(abs(paths.pose[1, 5, 2]), np.pi, atol=1e-4)


def test_the_egos_gaps_are_all_filled(build_scene):
    valid = np.ones((1, 91), bool)
    valid[0, 30:70] = False

    paths = read_paths(build_scene(line()[None], [CAR], valid), SETTINGS)

    assert paths.valid.all()
    np.testing.assert_allclose(paths.pose[0, 10, :2], [50.0, 0.0], atol=1e-4)


@pytest.mark.parametrize("missing", [slice(0, 6), slice(80, 91)])
def test_a_log_that_does_not_show_the_ego_at_its_ends_is_refused(build_scene, missing):
    valid = np.ones((1, 91), bool)
    valid[0, missing] = False

    with pytest.raises(TokensError, match="the ego is not observed at step"):
        read_paths(build_scene(line()[None], [CAR], valid), SETTINGS)


def test_agents_are_cut_where_they_are_too_far_from_the_ego(build_scene):
    # The other car falls back by 10 m/s: 150 m away at step 50, no longer nearer there.
    path = np.stack([line(), line((-100, 0), (0, 0))])
    scene = build_scene(path, [CAR, CAR])

    assert tokens_of(scene) == list(range(9))
    assert tokens_of(scene, dataclasses.replace(SETTINGS, max_ego_distance_m=1e9)) == list(
        range(18)
    )


@pytest.mark.parametrize(
    ("span", "enters_m", "expected"),
    [
        ((20, 91), 0.0, range(4, 18)),  # Where it is first seen, 80 m away.
        ((20, 91), 40.0, range(12, 18)),  # It comes within 40 m at step 61.
        ((0, 91), 40.0, range(18)),  # It is there now, however far.
        ((20, 60), 40.0, ()),  # It never comes near.
    ],
)
def test_who_comes_from_beyond_is_observed_from_within_on(
    build_scene, span, enters_m, expected
):
    valid = np.stack([np.ones(91, bool), shown(91, span)])
    path = np.stack([line(velocity_mps=(0, 0)), line((100, 0), (-9.99, 0))])
    settings = dataclasses.replace(SETTINGS, insertion_distance_m=enters_m)

    assert tokens_of(build_scene(path, [CAR, CAR], valid), settings) == list(expected)


def test_who_has_come_near_is_observed_however_far_it_then_goes(build_scene):
    valid = np.stack([np.ones(91, bool), shown(91, (20, 91))])
    path = np.stack([line(velocity_mps=(0, 0)), line((10, 0), (10, 0))])
    settings = dataclasses.replace(SETTINGS, insertion_distance_m=40.0)

    assert tokens_of(build_scene(path, [CAR, CAR], valid), settings) == list(range(4, 18))


def test_an_agent_that_is_never_near_is_told_apart(build_scene):
    path = np.stack([line(), line((0, 99)), line((0, 101))])

    near = read_paths(build_scene(path, [CAR] * 3), SETTINGS).near

    np.testing.assert_array_equal(near, [True, True, False])


def test_only_road_users_are_read(build_scene):
    path = np.stack([line((0, 5)), line(), line((0, 9))])

    paths = read_paths(build_scene(path, [OTHER, CAR, WALKER], ego=1), SETTINGS)

    np.testing.assert_array_equal(paths.agent_type, [CAR, WALKER])
    np.testing.assert_array_equal(paths.track_id, [101, 102])
    assert paths.ego == 0


def test_an_ego_that_is_no_road_user_is_refused(build_scene):
    with pytest.raises(TokensError, match="the ego is of kind 3"):
        read_paths(build_scene(line()[None], [OTHER]), SETTINGS)


def test_the_box_is_the_mean_over_the_steps_that_show_the_agent(beside_ego):
    scene = beside_ego((10, 14))
    size = scene.tracks.size_lwh_m.copy()
    size[1, 10:14, 0] = [4.0, 4.0, 5.0, 7.0]
    tracks = dataclasses.replace(scene.tracks, size_lwh_m=size)

    paths = read_paths(dataclasses.replace(scene, tracks=tracks), SETTINGS)

    np.testing.assert_allclose(paths.size_lwh_m[1], [5.0, 2.0, 1.6], rtol=1e-6)


def test_whoever_is_known_now_has_a_token_that_ends_now(beside_ego):
    # Gone for more than a second, and back at step 20 only: "now" of this log.
    scene = beside_ego((0, 6), (20, 91), now=20)

    assert tokens_of(scene) == [0, *range(3, 18)]
    assert read_paths(scene, SETTINGS).at_now.all()


def test_whoever_comes_back_shortly_before_now_has_a_token_that_ends_now(beside_ego):
    paths = read_paths(beside_ego((0, 6), (18, 91), now=20), SETTINGS)

    assert paths.valid[1, 3]
    np.testing.assert_allclose(paths.pose[1, 3], [15.0, 5.0, 0.0], atol=1e-4)


def test_a_log_read_until_now_does_not_know_the_rest(beside_ego):
    """A gap that only the future closes stays open."""
    scene = beside_ego((0, 9), (12, 91))

    assert tokens_of(scene) == list(range(18))
    assert tokens_of(scene, until=10) == [0]
    assert not read_paths(scene, SETTINGS, until=10).at_now[1]


@pytest.mark.parametrize(
    ("steps", "now", "reason"),
    [
        (5, 0, "5 steps hold no whole token"),
        (91, 12, "the history ends at step 12 of 90"),
        (91, 0, "the history ends at step 0 of 90"),
        (14, 13, "the history ends at step 13 of 13"),
    ],
)
def test_logs_whose_time_does_not_fit_tokens_are_refused(drive, steps, now, reason):
    with pytest.raises(TokensError, match=reason):
        read_paths(drive(steps=steps, now=now), SETTINGS)


def test_headings_that_flip_are_turned_back():
    heading = np.float32([[0.0, 0.1, 0.1 + np.pi - 2 * np.pi, 0.2, 3.0, 3.1]])
    valid = np.ones_like(heading, bool)

    cleaned = clean_headings(heading, valid)

    np.testing.assert_allclose(cleaned, [[0.0, 0.1, 0.1, 0.2, 0.2, 0.2]])


def test_headings_are_compared_across_the_half_turn_and_never_across_gaps():
    heading = np.float32([[3.1, -3.1, 0.0, 2.0, 2.1]])
    valid = np.array([[True, True, False, True, True]])

    np.testing.assert_array_equal(clean_headings(heading, valid), heading)


def test_cleaning_leaves_its_input_alone():
    heading = np.float32([[0.0, 3.0]])

    clean_headings(heading, np.ones_like(heading, bool))

    np.testing.assert_array_equal(heading, np.float32([[0.0, 3.0]]))
