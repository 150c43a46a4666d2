import dataclasses

import numpy as np
import pytest

from infgen.config import VocabSettings
from infgen.scene import AgentType
from infgen.tokens.clustering.motion_samples import (
    NO_MOTION_SAMPLES,
    MotionSamples,
    corner_gap_m,
    merge_motion_samples,
    scene_motion_samples,
)
from infgen.tokens.clustering.physical_limits import keeps_limits, motion_limits

LIMITS = motion_limits(VocabSettings())
STILL_M = 0.05


def segments_of(scene):
    return scene_motion_samples(scene, LIMITS, STILL_M)


def with_tracks(scene, **changes):
    return dataclasses.replace(scene, tracks=dataclasses.replace(scene.tracks, **changes))


def test_a_drive_of_nine_seconds_gives_eighteen_equal_moves(drive):
    found = segments_of(drive(speed_mps=10.0))
    assert found.num_samples == 18
    assert (found.agent_type == AgentType.VEHICLE).all()
    straight = np.column_stack([np.arange(6), np.zeros(6), np.zeros(6)])
    np.testing.assert_allclose(found.path, np.broadcast_to(straight, (18, 6, 3)), atol=1e-4)


def test_moves_do_not_depend_on_where_and_which_way_the_scene_lies(drive):
    for heading_rad in (0.5, 3.0, -2.2):
        found = segments_of(drive(speed_mps=7.0, heading_rad=heading_rad))
        np.testing.assert_allclose(found.path[:, -1, 0], 3.5, atol=1e-4)
        np.testing.assert_allclose(found.path[:, :, 1:], 0, atol=1e-4)


def test_moves_start_only_where_all_six_steps_are_seen(drive):
    scene = drive()
    valid = scene.tracks.valid.copy()
    valid[0, 22] = False  # within the move of steps 20 to 25
    valid[0, 40] = False  # the end of one and the start of another
    assert segments_of(with_tracks(scene, valid=valid)).num_samples == 18 - 1 - 2


@pytest.mark.parametrize(
    ("steps", "seen", "moves"), [(91, 29, 0), (91, 31, 6), (11, 11, 2)]
)
def test_agents_seen_briefly_give_no_moves_but_in_short_logs(drive, steps, seen, moves):
    scene = drive(steps=steps, now=5)
    valid = np.zeros_like(scene.tracks.valid)
    valid[0, :seen] = True
    assert segments_of(with_tracks(scene, valid=valid)).num_samples == moves


def test_logs_of_any_length_are_cut(drive):
    assert segments_of(drive(steps=198)).num_samples == 39
    assert segments_of(drive(steps=5, now=1)).num_samples == 0


def test_who_stands_still_gives_no_moves(parked):
    assert segments_of(parked()).num_samples == 0


def test_other_agents_give_no_moves(drive):
    assert segments_of(drive(kind=AgentType.OTHER)).num_samples == 0


def test_a_teleport_gives_no_move(drive):
    scene = drive(speed_mps=5.0)
    xyz_m = scene.tracks.xyz_m.copy()
    xyz_m[0, 43:, 0] += 30.0
    found = segments_of(with_tracks(scene, xyz_m=xyz_m))
    assert found.num_samples == 17
    np.testing.assert_allclose(found.path[:, -1, 0], 2.5, atol=1e-3)


def test_headings_that_flip_are_mended_before_moves_are_cut(drive):
    scene = drive(speed_mps=5.0)
    heading_rad = scene.tracks.heading_rad.copy()
    heading_rad[0, 30:50] = np.pi
    found = segments_of(with_tracks(scene, heading_rad=heading_rad))
    assert found.num_samples == 18
    np.testing.assert_allclose(found.path[..., 2], 0, atol=1e-6)


def test_every_move_of_a_noisy_log_is_within_the_limits(drive):
    scene = drive(speed_mps=12.0, kind=AgentType.CYCLIST)
    noise = np.random.default_rng(0).normal(0, 0.03, scene.tracks.xyz_m.shape)
    found = segments_of(with_tracks(scene, xyz_m=scene.tracks.xyz_m + np.float32(noise)))
    assert found.num_samples > 9
    assert keeps_limits(found.path, AgentType.CYCLIST, LIMITS).all()


def test_keys_name_scene_track_and_start(crossing):
    scene = crossing()
    found, again = segments_of(scene), segments_of(scene)
    assert len(np.unique(found.key)) == found.num_samples
    np.testing.assert_array_equal(found.key, again.key)
    other = segments_of(dataclasses.replace(scene, scenario_id="another"))
    assert not np.isin(found.key, other.key).any()


def test_a_sample_holds_so_many_of_each_kind_whatever_the_order_of_its_parts(crossing):
    parts = [
        segments_of(dataclasses.replace(crossing(), scenario_id=str(number)))
        for number in range(6)
    ]
    sample = merge_motion_samples(parts, 20)
    np.testing.assert_array_equal(np.bincount(sample.agent_type), [20, 20, 20])
    halves = [merge_motion_samples(parts[3:], 20), merge_motion_samples(parts[:3], 20)]
    again = merge_motion_samples(halves, 20)
    for field in dataclasses.fields(MotionSamples):
        np.testing.assert_array_equal(
            getattr(again, field.name), getattr(sample, field.name)
        )


def test_a_scene_that_is_met_twice_counts_once(drive):
    found = segments_of(drive())
    assert merge_motion_samples([found, found, NO_MOTION_SAMPLES], 1000).num_samples == 18


def test_box_corners_are_as_far_apart_as_the_box_has_moved():
    away = np.float32([[3.0, 4.0, 0.0]])
    np.testing.assert_allclose(corner_gap_m(away, 0 * away, AgentType.CYCLIST), [5.0])
    turned = np.float32([[0, 0, np.pi]])
    diagonal = np.hypot(4.8, 2.0)
    np.testing.assert_allclose(
        corner_gap_m(turned, 0 * turned, AgentType.VEHICLE), [diagonal], rtol=1e-6
    )


def test_paths_of_a_kind_are_seen_from_their_start(crossing):
    found = segments_of(crossing())
    walked = found.of_agent_type(AgentType.PEDESTRIAN)
    assert len(walked) == 12
    np.testing.assert_allclose(walked[:, -1, 0], 0.7, atol=1e-4)
    assert not walked[:, 0].any()
