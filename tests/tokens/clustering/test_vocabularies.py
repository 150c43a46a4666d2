import dataclasses

import numpy as np
import pytest
from pydantic import ValidationError

from infgen.config import VocabSettings
from infgen.scene import AgentType
from infgen.tokens.clustering.kdisks import mean_gap_m
from infgen.tokens.clustering.made_map_samples import make_arcs
from infgen.tokens.clustering.made_motion_samples import make_fan
from infgen.tokens.clustering.motion_samples import (
    NO_MOTION_SAMPLES,
    MotionSamples,
    merge_motion_samples,
)
from infgen.tokens.clustering.physical_limits import (
    keeps_limits,
    motion_limits,
    plausible,
    smooth,
)
from infgen.tokens.clustering.sample_keys import item_keys
from infgen.tokens.clustering.vocabularies import (
    MAX_ANCHOR_SHARE,
    MapSpace,
    MotionSpace,
    Origin,
    cluster_map,
    cluster_motion,
)
from infgen.tokens.vocabulary import STATIONARY_TOKEN

SETTINGS = VocabSettings(num_motion_tokens=128, num_map_tokens=64)
LIMITS = motion_limits(SETTINGS)
KINDS = range(3)


def logged_moves(rng, many=3000, kinds=(0, 1, 2), bias=0.0):
    """Noisy moves of all speeds; ``bias`` turns them to the left."""
    kind = rng.choice(kinds, many).astype(np.int8)
    ahead = rng.uniform(0, 1, many) * np.array([9.0, 1.5, 4.0])[kind]
    turn = rng.normal(bias, 0.1, many)
    share = np.linspace(0, 1, 6)
    path = np.stack([ahead, ahead * turn / 2, turn], axis=-1)[:, None] * share[:, None]
    path[:, 1:, :2] += rng.normal(0, 0.01, (many, 5, 2))
    path = path.astype(np.float32)
    fit = np.zeros(many, bool)
    for one in KINDS:
        rows = kind == one
        fit[rows] = plausible(path[rows], one, LIMITS)
        path[rows] = smooth(path[rows], one, LIMITS)
    key = item_keys("logged", np.arange(many))
    return merge_motion_samples([MotionSamples(key[fit], kind[fit], path[fit])], 10**6)


def logged_curves(rng, many=2000):
    """Lines that bend to the left, of three lengths."""
    turn = np.abs(rng.normal(0, 0.5, many))[:, None] * np.arange(10) / 9
    length = rng.choice([5.0, 5.0, 2.0], many)[:, None, None]
    steps = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * length / 10
    curve = np.concatenate([np.zeros((many, 1, 2)), np.cumsum(steps, axis=1)], axis=1)
    return curve.astype(np.float32)


def least_gaps(space, items):
    points = space.points_m(items)
    return np.array([np.partition(mean_gap_m(points, one), 1)[1] for one in points])


@pytest.fixture(scope="module")
def clustered():
    return cluster_motion(logged_moves(np.random.default_rng(0)), SETTINGS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_codebook_is_full_and_its_first_move_stands_still(clustered, kind):
    vocabulary, origin = clustered
    assert vocabulary.path.shape == (3, 128, 6, 3)
    assert not vocabulary.path[kind, STATIONARY_TOKEN].any()
    assert origin[kind, STATIONARY_TOKEN] == Origin.MADE
    assert not vocabulary.path[:, :, 0].any()
    np.testing.assert_array_equal(vocabulary.real, origin == Origin.LOGGED)


@pytest.mark.parametrize("kind", KINDS)
def test_no_move_is_beyond_the_limits_and_no_two_are_within_the_tolerance(clustered, kind):
    path = clustered[0].path[kind]
    assert keeps_limits(path, kind, LIMITS).all()
    assert (least_gaps(MotionSpace(kind, LIMITS), path) > SETTINGS.tolerance_m).all()


def test_enough_logs_leave_only_anchors_and_the_stand_still_to_be_made(clustered):
    origin = clustered[1][AgentType.VEHICLE]
    assert (origin == Origin.MIRRORED).sum() == 0
    assert (origin == Origin.MADE).sum() <= 1 + 128 * MAX_ANCHOR_SHARE
    assert (origin == Origin.LOGGED).sum() >= 128 * (1 - MAX_ANCHOR_SHARE) - 1


def test_logs_that_only_turn_left_are_mirrored_where_they_do_not_fill_the_codebook():
    few = logged_moves(np.random.default_rng(1), many=60, bias=0.3)
    vocabulary, origin = cluster_motion(few, SETTINGS)
    for kind in KINDS:
        mirrored = vocabulary.path[kind, origin[kind] == Origin.MIRRORED]
        assert len(mirrored) > 0
        assert mirrored[:, -1, 2].mean() < -0.1
        logged = vocabulary.path[kind, origin[kind] == Origin.LOGGED]
        assert logged[:, -1, 2].mean() > 0.1
    _, plain = cluster_motion(few, dataclasses.replace(SETTINGS, mirror=False))
    assert not (plain == Origin.MIRRORED).any()
    assert not vocabulary.real[origin != Origin.LOGGED].any()


def test_without_any_log_codebooks_are_full_of_arcs_within_the_limits():
    vocabulary, origin = cluster_motion(NO_MOTION_SAMPLES, SETTINGS)
    assert (origin == Origin.MADE).all()
    for kind in KINDS:
        assert keeps_limits(vocabulary.path[kind], kind, LIMITS).all()
        gaps = least_gaps(MotionSpace(kind, LIMITS), vocabulary.path[kind])
        assert (gaps > SETTINGS.tolerance_m).all()
        speed_mps = vocabulary.end_pose[kind, :, 0] / 0.5
        assert speed_mps.max() > 0.8 * LIMITS.speed_mps[kind]


def test_a_codebook_larger_than_the_tolerance_allows_is_filled_at_less_of_it():
    settings = VocabSettings(num_motion_tokens=96, tolerance_m=2.0)
    vocabulary, _ = cluster_motion(NO_MOTION_SAMPLES, settings)
    for kind in KINDS:
        gaps = least_gaps(MotionSpace(kind, LIMITS), vocabulary.path[kind])
        assert 0 < gaps.min() < 2.0
        assert keeps_limits(vocabulary.path[kind], kind, LIMITS).all()


def test_moves_do_not_depend_on_the_order_in_which_segments_are_gathered(clustered):
    segments = logged_moves(np.random.default_rng(0))
    shuffled = np.random.default_rng(9).permutation(segments.num_samples)
    parts = [
        MotionSamples(segments.key[rows], segments.agent_type[rows], segments.path[rows])
        for rows in np.array_split(shuffled, 7)
    ]
    again, origin = cluster_motion(merge_motion_samples(parts, 10**6), SETTINGS)
    assert again.path.tobytes() == clustered[0].path.tobytes()
    assert origin.tobytes() == clustered[1].tobytes()


def test_another_seed_lays_other_disks():
    segments = logged_moves(np.random.default_rng(0))
    other, _ = cluster_motion(segments, dataclasses.replace(SETTINGS, seed=1))
    same, _ = cluster_motion(segments, SETTINGS)
    assert not np.array_equal(other.path, same.path)


def test_headings_are_averaged_round_the_circle():
    space = MotionSpace(AgentType.PEDESTRIAN, LIMITS)
    path = np.zeros((2, 6, 3), np.float32)
    path[0, :, 2], path[1, :, 2] = np.pi - 0.1, -np.pi + 0.1
    assert np.abs(space.mean(path)[:, 2]) == pytest.approx(np.pi)


def test_roads_fill_their_codebook_and_are_apart():
    vocabulary, origin, tolerance_m = cluster_map(
        logged_curves(np.random.default_rng(0)), SETTINGS
    )
    assert vocabulary.curve_m.shape == (64, 11, 2)
    assert (least_gaps(MapSpace(), vocabulary.curve_m) > tolerance_m).all()
    assert not vocabulary.curve_m[:, 0].any()
    np.testing.assert_allclose(vocabulary.curve_m[:, 1, 1], 0, atol=1e-5)
    assert (vocabulary.curve_m[:, 1, 0] > 0).all()
    assert (origin == Origin.LOGGED).sum() > 32


def test_a_given_road_tolerance_is_taken():
    settings = dataclasses.replace(SETTINGS, map_tolerance_m=0.4)
    curves = logged_curves(np.random.default_rng(0))
    vocabulary, origin, tolerance_m = cluster_map(curves, settings)
    assert tolerance_m == 0.4
    logged = vocabulary.curve_m[origin == Origin.LOGGED]
    assert (least_gaps(MapSpace(), logged) > 0.4 / 4).all()


def test_without_any_map_the_codebook_holds_arcs_both_ways():
    none = np.empty((0, 11, 2), np.float32)
    vocabulary, origin, _ = cluster_map(none, SETTINGS)
    assert (origin == Origin.MADE).all()
    assert (vocabulary.curve_m[:, -1, 1] > 0.1).any()
    assert (vocabulary.curve_m[:, -1, 1] < -0.1).any()
    straight = np.abs(vocabulary.curve_m - np.float32([[0.5, 0]]) * np.arange(11)[:, None])
    assert straight.max(axis=(1, 2)).min() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_a_fan_is_as_wide_to_the_left_as_to_the_right(kind):
    path = make_fan(kind, LIMITS, 0.2)
    ends = {tuple(np.round(p[-1], 4) + 0.0) for p in path}
    mirrored = {(x, -y + 0.0, -h + 0.0) for x, y, h in ends}
    assert ends == mirrored
    assert len(path) == len(ends) > 50
    assert keeps_limits(path, kind, LIMITS).all()


def test_a_fan_begins_with_the_most_ordinary_move():
    path = make_fan(AgentType.VEHICLE, LIMITS, 0.1)
    assert np.abs(path[:20, -1, 2]).max() < 0.3
    assert 0 <= path[:20, -1, 0].max() < 5


def test_arcs_of_lines_begin_straight_and_lie_along_x():
    curve = make_arcs(0.2)
    np.testing.assert_allclose(curve[0, :, 0], 0.5 * np.arange(11), atol=1e-6)
    np.testing.assert_allclose(curve[:, 1, 1], 0, atol=1e-7)
    lengths = np.linalg.norm(np.diff(curve, axis=1), axis=-1)
    assert (lengths.max(axis=1) - lengths.min(axis=1)).max() < 1e-5
    assert lengths.sum(axis=1).max() == pytest.approx(5.0, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tolerance_m", 0.0),
        ("num_motion_tokens", 1),
        ("num_map_tokens", 40_000),
        ("max_accel_mps2", -1.0),
    ],
)
def test_settings_that_no_codebook_can_be_made_with_are_refused(name, value):
    with pytest.raises(ValidationError, match=rf"{name}\s+Input should be"):
        dataclasses.replace(SETTINGS, **{name: value})


def test_slow_kinds_still_get_whole_codebooks():
    settings = dataclasses.replace(
        SETTINGS,
        pedestrian_max_speed_mps=1.0,
        max_yaw_rate_rad_s=0.1,
        max_accel_mps2=1.0,
    )
    vocabulary, _ = cluster_motion(NO_MOTION_SAMPLES, settings)
    for kind in KINDS:
        assert keeps_limits(vocabulary.path[kind], kind, motion_limits(settings)).all()
