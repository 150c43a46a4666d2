"""Agents led astray, and the moves that lead them back.

The vocabulary moves by decimetres straight ahead, and the agents by a metre each token
step, so every expected number can be done in the head.
"""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from infgen.config import TrainSettings
from infgen.model.batching.perturbation import (
    LoggedMotion,
    Perturbation,
    make_perturbation,
    perturb_map,
    perturb_motion,
    perturb_scenes,
)
from infgen.model.batching.recovery import WHOLE_RECOVERY, Recovery
from infgen.tokens.motion_tokens import advance, make_match_table, nearest_motion_tokens
from infgen.tokens.scene_tokens import NO_MOTION_TOKEN
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

ITSELF = np.arange(9, dtype=np.int16)[:, None]


def straight_moves(step_m=0.1, count=31):
    """Row ``i`` goes ``i`` steps ahead."""
    path = np.zeros((3, count, 6, 3), np.float32)
    path[..., 0] = step_m * np.arange(count)[:, None] * np.linspace(0, 1, 6)
    return MotionVocabulary(BOX_LW_M, path, np.ones((3, count), bool))


@functools.cache
def fan_moves():
    """About five metres ahead, to either side, facing anywhere ahead."""
    ahead_m, left_m, turn_rad = np.meshgrid(
        np.linspace(4.5, 5.5, 11), np.linspace(-1.5, 1.5, 31), np.linspace(-0.4, 0.4, 9)
    )
    ends = np.stack([ahead_m, left_m, turn_rad], axis=-1).reshape(-1, 3)
    path = ends[None, :, None] * np.linspace(0, 1, 6)[:, None]
    path = np.repeat(path.astype(np.float32), 3, axis=0)
    return MotionVocabulary(BOX_LW_M, path, np.ones(path.shape[:2], bool))


@functools.cache
def fan_matches():
    return make_match_table(fan_moves())


def noise_of(vocabulary, moves, share=1.0, drift=0.0, recovery=WHOLE_RECOVERY):
    wide = vocabulary is fan_moves()
    matches = fan_matches() if wide else make_match_table(vocabulary)
    return Perturbation(matches, moves, share, drift, ITSELF, recovery)


def five_metre_drives(vocabulary, agents=400, tokens=18):
    agent_type, pose, motion_token, moving = metre_drives(agents, tokens)
    pose[..., 0] *= 5
    straight = np.hypot(vocabulary.end_pose[0, :, 0] - 5, vocabulary.end_pose[0, :, 1])
    straight += np.abs(vocabulary.end_pose[0, :, 2])
    motion_token[:, 1:] = straight.argmin()
    return agent_type, pose, motion_token, moving


def metre_drives(agents=4, tokens=18):
    """Kind, pose and move of agents that go a metre each token, and when they move."""
    pose = np.zeros((agents, tokens, 3), np.float32)
    pose[..., 0] = np.arange(tokens)
    pose[..., 1] = 5.0 * np.arange(agents)[:, None]
    motion_token = np.full((agents, tokens), 10, np.int16)
    motion_token[:, 0] = NO_MOTION_TOKEN
    moving = np.ones((agents, tokens), bool)
    moving[:, 0] = False
    return np.zeros(agents, np.int8), pose, motion_token, moving


def random_drives(vocabulary, seed, agents=20, tokens=10):
    """Agents of all kinds on random moves, with gaps after which they start elsewhere."""
    random = np.random.default_rng(seed)
    agent_type = random.integers(3, size=agents).astype(np.int8)
    motion_token = random.integers(
        vocabulary.num_motion_tokens, size=(agents, tokens)
    ).astype(np.int16)
    moving = random.random((agents, tokens)) < 0.8
    moving[:, 0] = False
    pose = random.normal(size=(agents, tokens, 3)).astype(np.float32)
    for token in range(1, tokens):
        rows = np.flatnonzero(moving[:, token])
        ends = advance(
            pose[rows, token - 1], agent_type[rows], motion_token[rows, token], vocabulary
        )
        pose[rows, token] = ends
    return (
        agent_type,
        pose,
        np.where(moving, motion_token, NO_MOTION_TOKEN).astype(np.int16),
        moving,
    )


def stray(drives, noise, seed=0):
    return perturb_motion(drawn(drives, noise, seed), noise)


def drawn(drives, noise, seed=0):
    return LoggedMotion.drawn(*drives, noise, np.random.default_rng(seed))


@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.5]))
@settings(max_examples=10)
def test_scenes_stray_together_as_they_do_alone(seed, drift):
    vocabulary = fan_moves()
    noise = noise_of(vocabulary, 9, share=0.5, drift=drift)
    sizes = ((3, 18), (0, 5), (7, 11))
    scenes = [
        drawn(random_drives(vocabulary, seed + i, *size), noise, seed)
        for i, size in enumerate(sizes)
    ]

    together = perturb_scenes(scenes, noise)

    for scene, found in zip(scenes, together, strict=True):
        for ours, alone in zip(found, perturb_motion(scene, noise), strict=True):
            np.testing.assert_array_equal(ours, alone)
    assert perturb_scenes([], noise) == []


def test_agents_stray_by_a_step_of_the_codebook_and_no_farther():
    drives = metre_drives(agents=50)

    strays = stray(drives, noise_of(straight_moves(), 3))

    off_m = strays.pose[..., 0] - drives[1][..., 0]
    assert np.abs(off_m).max() < 0.1001
    for value_m in (-0.1, 0.0, 0.1):
        share = np.isclose(off_m[:, 1:], value_m, atol=1e-3).mean()
        assert 0.25 < share < 0.42


def test_the_move_to_learn_makes_good_what_the_last_one_missed():
    drives = metre_drives()

    strays = stray(drives, noise_of(straight_moves(), 3))

    missed_m = drives[1][:, :-1, 0] - strays.pose[:, :-1, 0]
    wanted = 10 + np.rint(10 * missed_m)
    np.testing.assert_array_equal(strays.label[:, 1:], wanted)
    assert set(np.unique(strays.label[:, 1:])) == {9, 10, 11}
    assert (strays.motion_token != strays.label).any()


@given(st.integers(0, 2**32), st.sampled_from([1, 2, 5, 31]))
@settings(max_examples=25)
def test_poses_follow_moves_and_labels_are_the_nearest_moves(seed, few):
    vocabulary = straight_moves()
    noise = noise_of(vocabulary, few)
    drives = random_drives(vocabulary, seed)
    agent_type, pose, _, moving = drives

    strays = stray(drives, noise, seed)

    for token in range(1, pose.shape[1]):
        rows = np.flatnonzero(moving[:, token])
        before, kinds = strays.pose[rows, token - 1], agent_type[rows]
        ends = advance(before, kinds, strays.motion_token[rows, token], vocabulary)
        np.testing.assert_allclose(strays.pose[rows, token], ends, atol=1e-5)
        best = nearest_motion_tokens(pose[rows, token], before, kinds, noise.table)
        np.testing.assert_array_equal(strays.label[rows, token], best)


@given(st.integers(0, 2**32))
@settings(max_examples=25)
def test_who_makes_no_move_is_where_it_should_be_and_starts_from_there(seed):
    drives = _, pose, motion_token, moving = random_drives(straight_moves(), seed)

    strays = stray(drives, noise_of(straight_moves(), 5))

    np.testing.assert_array_equal(strays.pose[~moving], pose[~moving])
    np.testing.assert_array_equal(strays.motion_token[~moving], motion_token[~moving])
    np.testing.assert_array_equal(strays.label[~moving], motion_token[~moving])
    assert not strays.off[~moving].any()
    first = moving.copy()
    first[:, 1:] &= ~moving[:, :-1]
    np.testing.assert_array_equal(strays.label[first], motion_token[first])


@pytest.mark.parametrize(("moves", "share"), [(1, 1.0), (5, 0.0)])
def test_without_a_choice_nothing_changes_to_the_last_bit(moves, share):
    drives = random_drives(straight_moves(), 7)

    strays = stray(drives, noise_of(straight_moves(), moves, share))

    for found, logged in zip(strays, (drives[2], drives[1], drives[2]), strict=False):
        assert found.tobytes() == logged.tobytes()
    assert not strays.off.any()


def test_only_a_share_of_the_moves_is_drawn():
    drives = metre_drives(agents=200)

    strays = stray(drives, noise_of(straight_moves(), 3, share=0.5))

    drawn = (strays.motion_token != strays.label)[:, 1:].mean()
    assert 0.30 < drawn < 0.37  # Half of two in three: one in three is the nearest.


def test_moves_that_end_far_off_are_not_taken():
    # Moves of whole metres: all but the nearest end a metre off.
    drives = metre_drives()
    vocabulary = straight_moves(step_m=1.0, count=5)
    drives[2][:, 1:] = 1

    strays = stray(drives, noise_of(vocabulary, 3))

    np.testing.assert_array_equal(strays.motion_token, drives[2])


@pytest.mark.parametrize(("way_m", "off_m"), [(0, 0), (1.8, 0), (3, 0.3), (30, 0.9)])
def test_the_slow_stray_less_and_who_stands_not_at_all(way_m, off_m):
    agent_type, pose, motion_token, moving = metre_drives(agents=20, tokens=4)
    pose[..., 0] *= way_m
    vocabulary = straight_moves(step_m=0.3, count=120)
    motion_token[:, 1:] = round(way_m / 0.3)

    strays = stray((agent_type, pose, motion_token, moving), noise_of(vocabulary, 20))

    farthest_m = np.abs(strays.pose[..., 0] - pose[..., 0]).max()
    assert farthest_m == pytest.approx(off_m, abs=1e-3)


def test_a_share_of_the_drivers_drifts_for_seconds_and_learns_the_way_back():
    vocabulary = fan_moves()
    drives = five_metre_drives(vocabulary)

    strays = stray(drives, noise_of(vocabulary, 1, drift=0.5))

    aside_m = strays.pose[..., 1] - drives[1][..., 1]
    drifts = np.abs(aside_m).max(axis=1) > 0.2
    assert 0.4 < drifts.mean() < 0.6
    np.testing.assert_allclose(aside_m[~drifts], 0.0, atol=1e-3)
    settled_m = aside_m[drifts, 6:]
    assert 0.45 < settled_m.std() < 0.8  # 0.15 of five metres, less what is cut off.
    assert np.abs(settled_m).max() < 1.6
    kept = (settled_m[:, 1:] * settled_m[:, :-1]).mean() / (settled_m**2).mean()
    assert 0.7 < kept < 0.85
    # Whoever is far to one side is to go to the other.
    back_m = vocabulary.end_pose[0, strays.label[drifts, 7:], 1]
    turned_rad = strays.pose[drifts, 6:-1, 2]
    across_m = 5 * np.sin(turned_rad) + back_m * np.cos(turned_rad)
    far = np.abs(settled_m[:, :-1]) > 0.5
    assert (across_m[far] * settled_m[:, :-1][far] < 0).mean() > 0.95


def test_who_drifts_learns_to_come_back_by_the_share_that_is_to_be_made_good():
    vocabulary = fan_moves()
    drives = five_metre_drives(vocabulary)
    noise = noise_of(vocabulary, 1, drift=1.0, recovery=Recovery(along=0.0, lateral=0.2))

    strays = stray(drives, noise)

    aside_m = strays.pose[..., 1] - drives[1][..., 1]
    ends = advance(strays.pose[:, 6].copy(), drives[0], strays.label[:, 7], vocabulary)
    to_be_aside_m = ends[:, 1] - drives[1][:, 7, 1]
    far = np.abs(aside_m[:, 6]) > 0.5
    assert far.sum() > 50
    share = to_be_aside_m[far] / aside_m[far, 6]
    assert 0.75 < share.mean() < 0.85
    # All of it would be made good in one token step.
    whole = stray(drives, noise_of(vocabulary, 1, drift=1.0))
    ends = advance(whole.pose[:, 6].copy(), drives[0], whole.label[:, 7], vocabulary)
    assert np.abs(ends[far, 1] - drives[1][far, 7, 1]).mean() < 0.2


def test_with_noise_along_the_way_who_is_ahead_is_to_go_as_fast_as_the_log():
    vocabulary = straight_moves()
    drives = metre_drives(agents=50)
    noise = noise_of(vocabulary, 3, recovery=Recovery(along=0.0, lateral=1.0))

    strays = stray(drives, noise)

    assert (strays.motion_token[:, 1:] != 10).mean() > 0.5
    assert (strays.label[:, 1:] == 10).all()
    # Nothing is made good, so what they are ahead or behind adds up.
    ahead_m = strays.pose[..., 0] - drives[1][..., 0]
    assert ahead_m[:, 12:].std() > 2 * ahead_m[:, 1].std() > 0


def test_who_makes_good_a_share_strays_only_so_far():
    vocabulary = straight_moves()
    drives = metre_drives(agents=200, tokens=40)
    noise = noise_of(vocabulary, 3, recovery=Recovery(along=0.3, lateral=1.0))

    strays = stray(drives, noise)

    ahead_m = strays.pose[..., 0] - drives[1][..., 0]
    assert ahead_m[:, 30:].std() == pytest.approx(ahead_m[:, 10:20].std(), rel=0.2)
    never = noise_of(vocabulary, 3, recovery=Recovery(along=0.0, lateral=1.0))
    far_m = stray(drives, never).pose[..., 0] - drives[1][..., 0]
    assert ahead_m[:, 30:].std() < 0.5 * far_m[:, 30:].std()


def test_who_hardly_moves_does_not_drift():
    drives = metre_drives(agents=20)
    drives[1][..., 0] *= 0.7
    drives[2][:, 1:] = 7

    strays = stray(drives, noise_of(straight_moves(), 1, drift=1.0))

    assert not strays.off.any()


def test_equal_draws_lead_equally_astray_and_others_otherwise():
    drives, noise = metre_drives(), noise_of(straight_moves(), 5)

    one, two, other = (stray(drives, noise, seed) for seed in (1, 1, 2))

    assert all((a == b).all() for a, b in zip(one, two, strict=True))
    assert (one.motion_token != other.motion_token).any()


def test_nobody_is_led_nowhere():
    strays = stray(metre_drives(agents=0), noise_of(straight_moves(), 5))

    assert strays.motion_token.shape == (0, 18)


def test_settings_that_ask_for_no_noise_make_none(metre_moves, bent_roads):
    assert make_perturbation(TrainSettings(), metre_moves, bent_roads) is None


def test_road_tokens_are_drawn_from_the_nearest_shapes(metre_moves, bent_roads):
    noise = make_perturbation(
        TrainSettings(map_noise_neighbours=3), metre_moves, bent_roads
    )

    # Arcs that end 0, 5, 10, 20, 40 degrees to the left, then 5, 10, 20, 40 to the right.
    near = [set(row) for row in noise.near_map_tokens.tolist()]
    assert near[0] == {0, 1, 5}
    assert near[4] == {4, 3, 2}
    np.testing.assert_array_equal(noise.near_map_tokens[:, 0], np.arange(9))
    assert noise.moves == 0


def test_road_tokens_that_are_fixed_stay_and_others_become_what_is_near(
    metre_moves, bent_roads
):
    noise = make_perturbation(
        TrainSettings(map_noise_neighbours=3), metre_moves, bent_roads
    )
    random = np.random.default_rng(0)
    token = random.integers(9, size=900).astype(np.int16)
    fixed = random.random(900) < 0.3

    drawn = perturb_map(token, fixed, noise, random)

    np.testing.assert_array_equal(drawn[fixed], token[fixed])
    assert 0.25 < (drawn == token)[~fixed].mean() < 0.42
    assert all(
        new in noise.near_map_tokens[old] for old, new in zip(token, drawn, strict=True)
    )


def test_shapes_that_are_alike_stand_for_themselves_first(metre_moves):
    curve_m = np.zeros((2, 11, 2), np.float32)
    twins = MapVocabulary(curve_m, np.ones(2, bool))

    noise = make_perturbation(TrainSettings(map_noise_neighbours=1), metre_moves, twins)

    assert noise.near_map_tokens.tolist() == [[0], [1]]


def test_of_more_tokens_than_the_codebook_has_all_are_drawn_from(metre_moves, bent_roads):
    noise = make_perturbation(
        TrainSettings(motion_noise_neighbours=99, map_noise_neighbours=99),
        metre_moves,
        bent_roads,
    )

    assert noise.moves == metre_moves.num_motion_tokens
    assert noise.near_map_tokens.shape == (
        bent_roads.num_map_tokens,
        bent_roads.num_map_tokens,
    )


@pytest.mark.parametrize(
    "noise", [{"motion_noise_neighbours": 5}, {"lateral_drift_share": 0.5}]
)
def test_agents_are_led_astray_in_one_way_only(noise):
    with pytest.raises(ValidationError, match="set one of them to 0"):
        TrainSettings(**noise, closed_loop_top_k=32)


def test_drift_needs_no_other_noise(metre_moves, bent_roads):
    noise = make_perturbation(
        TrainSettings(lateral_drift_share=0.5), metre_moves, bent_roads
    )

    assert (noise.moves, noise.drift) == (1, 0.5)


@pytest.mark.parametrize("name", ["motion_noise_share", "lateral_drift_share"])
@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_is_from_none_to_all(name, share):
    with pytest.raises(ValidationError, match=name):
        TrainSettings(**{name: share})
