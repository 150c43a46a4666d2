import dataclasses

import numpy as np
import pytest
from pydantic import ValidationError

from infgen.config import VocabSettings
from infgen.scene import AgentType
from infgen.tokens.clustering.kdisks import gap_m
from infgen.tokens.clustering.made_map_samples import line_arcs
from infgen.tokens.clustering.made_motion_samples import fan
from infgen.tokens.clustering.motion_samples import NO_SEGMENTS, Segments, sample_segments
from infgen.tokens.clustering.physical_limits import ease, limits_of, plausible, within
from infgen.tokens.clustering.sample_keys import item_keys
from infgen.tokens.clustering.vocabularies import (
    ANCHOR_SHARE,
    MoveSpace,
    Origin,
    RoadSpace,
    cluster_moves,
    cluster_roads,
)
from infgen.tokens.vocabulary import STAND_STILL

SETTINGS = VocabSettings(num_motion_tokens=128, num_map_tokens=64)
LIMITS = limits_of(SETTINGS)
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
        path[rows] = ease(path[rows], one, LIMITS)
    key = item_keys("logged", np.arange(many))
    return sample_segments([Segments(key[fit], kind[fit], path[fit])], 10**6)


def logged_curves(rng, many=2000):
    """Lines that bend to the left, of three lengths."""
    turn = np.abs(rng.normal(0, 0.5, many))[:, None] * np.arange(10) / 9
    length = rng.choice([5.0, 5.0, 2.0], many)[:, None, None]
    steps = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * length / 10
    curve = np.concatenate([np.zeros((many, 1, 2)), np.cumsum(steps, axis=1)], axis=1)
    return curve.astype(np.float32)


def least_gaps(space, items):
    points = space.points_m(items)
    return np.array([np.partition(gap_m(points, one), 1)[1] for one in points])


@pytest.fixture(scope="module")
def clustered():
    return cluster_moves(logged_moves(np.random.default_rng(0)), SETTINGS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_codebook_is_full_and_its_first_move_stands_still(clustered, kind):
    codebook, origin = clustered
    assert codebook.path.shape == (3, 128, 6, 3)
    assert not codebook.path[kind, STAND_STILL].any()
    assert origin[kind, STAND_STILL] == Origin.MADE
    assert not codebook.path[:, :, 0].any()
    np.testing.assert_array_equal(codebook.real, origin == Origin.LOGGED)


@pytest.mark.parametrize("kind", KINDS)
def test_no_move_is_beyond_the_limits_and_no_two_are_within_the_tolerance(clustered, kind):
    path = clustered[0].path[kind]
    assert within(path, kind, LIMITS).all()
    assert (least_gaps(MoveSpace(kind, LIMITS), path) > SETTINGS.tolerance_m).all()


def test_enough_logs_leave_only_anchors_and_the_stand_still_to_be_made(clustered):
    origin = clustered[1][AgentType.VEHICLE]
    assert (origin == Origin.MIRRORED).sum() == 0
    assert (origin == Origin.MADE).sum() <= 1 + 128 * ANCHOR_SHARE
    assert (origin == Origin.LOGGED).sum() >= 128 * (1 - ANCHOR_SHARE) - 1


def test_logs_that_only_turn_left_are_mirrored_where_they_do_not_fill_the_codebook():
    few = logged_moves(np.random.default_rng(1), many=60, bias=0.3)
    codebook, origin = cluster_moves(few, SETTINGS)
    for kind in KINDS:
        mirrored = codebook.path[kind, origin[kind] == Origin.MIRRORED]
        assert len(mirrored) > 0
        assert mirrored[:, -1, 2].mean() < -0.1
        logged = codebook.path[kind, origin[kind] == Origin.LOGGED]
        assert logged[:, -1, 2].mean() > 0.1
    _, plain = cluster_moves(few, dataclasses.replace(SETTINGS, mirror=False))
    assert not (plain == Origin.MIRRORED).any()
    assert not codebook.real[origin != Origin.LOGGED].any()


def test_without_any_log_codebooks_are_full_of_arcs_within_the_limits():
    codebook, origin = cluster_moves(NO_SEGMENTS, SETTINGS)
    assert (origin == Origin.MADE).all()
    for kind in KINDS:
        assert within(codebook.path[kind], kind, LIMITS).all()
        gaps = least_gaps(MoveSpace(kind, LIMITS), codebook.path[kind])
        assert (gaps > SETTINGS.tolerance_m).all()
        speed_mps = codebook.end_pose[kind, :, 0] / 0.5
        assert speed_mps.max() > 0.8 * LIMITS.speed_mps[kind]


def test_a_codebook_larger_than_the_tolerance_allows_is_filled_at_less_of_it():
    settings = VocabSettings(num_motion_tokens=96, tolerance_m=2.0)
    codebook, _ = cluster_moves(NO_SEGMENTS, settings)
    for kind in KINDS:
        gaps = least_gaps(MoveSpace(kind, LIMITS), codebook.path[kind])
        assert 0 < gaps.min() < 2.0
        assert within(codebook.path[kind], kind, LIMITS).all()


def test_moves_do_not_depend_on_the_order_in_which_segments_are_gathered(clustered):
    segments = logged_moves(np.random.default_rng(0))
    shuffled = np.random.default_rng(9).permutation(segments.num_segments)
    parts = [
        Segments(segments.key[rows], segments.kind[rows], segments.path[rows])
        for rows in np.array_split(shuffled, 7)
    ]
    again, origin = cluster_moves(sample_segments(parts, 10**6), SETTINGS)
    assert again.path.tobytes() == clustered[0].path.tobytes()
    assert origin.tobytes() == clustered[1].tobytes()


def test_another_seed_lays_other_disks():
    segments = logged_moves(np.random.default_rng(0))
    other, _ = cluster_moves(segments, dataclasses.replace(SETTINGS, seed=1))
    same, _ = cluster_moves(segments, SETTINGS)
    assert not np.array_equal(other.path, same.path)


def test_headings_are_averaged_round_the_circle():
    space = MoveSpace(AgentType.PEDESTRIAN, LIMITS)
    path = np.zeros((2, 6, 3), np.float32)
    path[0, :, 2], path[1, :, 2] = np.pi - 0.1, -np.pi + 0.1
    assert np.abs(space.mean(path)[:, 2]) == pytest.approx(np.pi)


def test_roads_fill_their_codebook_and_are_apart():
    codebook, origin, tolerance_m = cluster_roads(
        logged_curves(np.random.default_rng(0)), SETTINGS
    )
    assert codebook.curve_m.shape == (64, 11, 2)
    assert (least_gaps(RoadSpace(), codebook.curve_m) > tolerance_m).all()
    assert not codebook.curve_m[:, 0].any()
    np.testing.assert_allclose(codebook.curve_m[:, 1, 1], 0, atol=1e-5)
    assert (codebook.curve_m[:, 1, 0] > 0).all()
    assert (origin == Origin.LOGGED).sum() > 32


def test_a_given_road_tolerance_is_taken():
    settings = dataclasses.replace(SETTINGS, map_tolerance_m=0.4)
    curves = logged_curves(np.random.default_rng(0))
    codebook, origin, tolerance_m = cluster_roads(curves, settings)
    assert tolerance_m == 0.4
    logged = codebook.curve_m[origin == Origin.LOGGED]
    assert (least_gaps(RoadSpace(), logged) > 0.4 / 4).all()


def test_without_any_map_the_codebook_holds_arcs_both_ways():
    none = np.empty((0, 11, 2), np.float32)
    codebook, origin, _ = cluster_roads(none, SETTINGS)
    assert (origin == Origin.MADE).all()
    assert (codebook.curve_m[:, -1, 1] > 0.1).any()
    assert (codebook.curve_m[:, -1, 1] < -0.1).any()
    straight = np.abs(codebook.curve_m - np.float32([[0.5, 0]]) * np.arange(11)[:, None])
    assert straight.max(axis=(1, 2)).min() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_a_fan_is_as_wide_to_the_left_as_to_the_right(kind):
    path = fan(kind, LIMITS, 0.2)
    ends = {tuple(np.round(p[-1], 4) + 0.0) for p in path}
    mirrored = {(x, -y + 0.0, -h + 0.0) for x, y, h in ends}
    assert ends == mirrored
    assert len(path) == len(ends) > 50
    assert within(path, kind, LIMITS).all()


def test_a_fan_begins_with_the_most_ordinary_move():
    path = fan(AgentType.VEHICLE, LIMITS, 0.1)
    assert np.abs(path[:20, -1, 2]).max() < 0.3
    assert 0 <= path[:20, -1, 0].max() < 5


def test_arcs_of_lines_begin_straight_and_lie_along_x():
    curve = line_arcs(0.2)
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
    codebook, _ = cluster_moves(NO_SEGMENTS, settings)
    for kind in KINDS:
        assert within(codebook.path[kind], kind, limits_of(settings)).all()
