from dataclasses import replace

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.metrics.long_term.binned import NO_BIN, bin_traffic
from infgen.metrics.long_term.metric import score_binned
from infgen.metrics.long_term.protocols import PROTOCOLS, ROW, STEP_FEATURES
from infgen.metrics.long_term.reference import count_log, log_probabilities
from infgen.metrics.long_term.table import Against, LogCounts, make_row
from infgen.metrics.traffic import LOGGED, from_log
from infgen.metrics.windows import cut_windows
from infgen.scene import FeatureType, Tracks
from infgen.spatial.road_edges import scene_road_edges

PAPER, CORRECTED = range(2)


def binned(scene, as_logged=True, radius_m=75.0):
    traffic = from_log(scene, TokenSettings())
    return bin_traffic(traffic, scene_road_edges(scene), radius_m, as_logged=as_logged)


def bins(one, feature, protocol=CORRECTED):
    return one.bins[protocol, ROW[feature]]


def test_bins_are_those_of_the_values(drive):
    one = binned(drive(speed_mps=11.0))

    # 11 m/s: the fifth bin of 2.5 m/s. The last step of the log has no speed.
    np.testing.assert_array_equal(bins(one, "linear_speed")[0, :-1], 4)
    assert bins(one, "linear_speed")[0, -1] == NO_BIN
    # The edge is 3 m to the right, the car 2 m wide: -2 m is the lower edge of bin 3.
    assert set(bins(one, "distance_to_road_edge")[0]) <= {2, 3}
    np.testing.assert_array_equal(bins(one, "offroad_indication")[0], 0)


def test_who_is_alone_is_far_from_others_when_corrected_and_left_out_on_paper(drive):
    one = binned(drive())

    np.testing.assert_array_equal(bins(one, "distance_to_nearest_object"), 9)
    np.testing.assert_array_equal(bins(one, "distance_to_nearest_object", PAPER), NO_BIN)


def test_invalid_steps_are_never_counted(crossing):
    scene = crossing()
    one = binned(scene)
    valid = scene.tracks.valid[:, 11:]

    for row, _ in enumerate(STEP_FEATURES):
        assert (one.bins[:, row][:, ~valid] == NO_BIN).all()
    there = bins(one, "time_to_collision") != NO_BIN
    np.testing.assert_array_equal(there, valid)


def test_an_acceleration_needs_two_valid_steps_on_either_side(crossing):
    one = binned(crossing())  # the pedestrian (row 2) is seen from step 30 on: 19 after now

    moving = bins(one, "linear_speed")[2] != NO_BIN
    changing = bins(one, "linear_acceleration")[2] != NO_BIN
    assert moving.argmax() == 20
    assert changing.argmax() == 21


def test_the_papers_boxes_replace_those_of_simulated_agents_only(parked):
    scene = parked()  # 4.8 m cars every 8 m: 3.2 m apart, with 4.3 m boxes 3.7 m
    near = replace(scene, tracks=_longer(scene.tracks, 2.0))
    logged, played = (binned(near, as_logged=flag) for flag in (True, False))

    # 6.8 m cars are 1.2 m apart (bin 1), the paper's boxes 3.7 m (bin 1) at most 4.0 m.
    feature = "offroad_indication"
    np.testing.assert_array_equal(
        bins(logged, feature, PAPER), bins(logged, feature, CORRECTED)
    )
    np.testing.assert_array_equal(bins(played, feature), bins(logged, feature))
    crashed = binned(replace(scene, tracks=_longer(scene.tracks, 4.0)), as_logged=False)
    assert (bins(crashed, "collision_indication", CORRECTED) == 1).any()
    assert not (bins(crashed, "collision_indication", PAPER) == 1).any()


def _longer(tracks: Tracks, by_m: float, wider_m: float = 0.0) -> Tracks:
    return replace(tracks, size_lwh_m=tracks.size_lwh_m + np.float32([by_m, wider_m, 0]))


def test_a_scene_without_road_edges_has_no_map_values(drive, build_map):
    scene = drive(road_map=build_map([(1, FeatureType.STOP_SIGN, 0, np.zeros((1, 2)))]))
    one = binned(scene)

    for feature in ("distance_to_road_edge", "offroad_indication"):
        assert (bins(one, feature) == NO_BIN).all()
    assert (bins(one, "linear_speed")[0, :-1] != NO_BIN).all()


def test_agents_are_counted_without_the_ego_near_and_far(parked):
    # Cars 8, 16 and 24 m ahead of the ego.
    one = binned(parked(), radius_m=17.0)

    np.testing.assert_array_equal(one.num_near, 2)
    np.testing.assert_array_equal(one.num_all, 3)


def test_other_things_on_the_road_are_neither_scored_nor_counted(build_scene):
    path = np.zeros((3, 91, 3))
    path[1, :, 0], path[2, :, 0] = 10.0, 20.0
    one = binned(build_scene(path, [0, 3, 1]))

    assert one.bins.shape[2] == 2
    np.testing.assert_array_equal(one.num_all, 1)


def test_a_log_is_read_as_a_rollout_of_its_own_index(crossing):
    one = binned(crossing())

    assert one.index == LOGGED
    assert one.there_now.tolist() == [True, True, False, True]
    assert one.entry_token.tolist() == [4]  # the pedestrian, from step 30: token 6
    assert one.exit_token.tolist() == [9]  # the cyclist, to step 60: token 11


@pytest.fixture
def against(crossing):
    one = binned(crossing())
    counts = count_log(one, cut_windows(80, 8.0, 0.5))
    logs = {one.scenario_id: LogCounts(one.num_near, one.num_all)}
    return Against(log_probabilities(counts), 2.0, 3.0, logs, 8.0, 0.5)


def test_a_row_has_every_number_by_name(crossing, against):
    row = make_row(binned(crossing(), as_logged=False), against)

    for protocol in PROTOCOLS:
        for name in ("composite", "kinematic", "placement", "entry_distance"):
            assert 0 < row.numbers[f"{protocol.name}/{name}"] <= 1
        # Ego and pedestrian meet on the crosswalk, the cyclist passes close by.
        assert 0 < row.numbers[f"{protocol.name}/collision_rate"] < 1
    assert row.numbers["ace/own_near"] == 0
    assert row.numbers["agents/all"] == pytest.approx(1 + (61 + 50) / 80)
    assert row.numbers["ace/split_all"] == pytest.approx(3 - 1 - 111 / 80)
    assert row.numbers["rate/entries"] == row.numbers["rate/exits"] == 1 / 8
    assert np.isnan(row.numbers["ace/truth_near"])


def test_a_row_has_the_rates_of_what_a_protocol_counts(crossing, against):
    row = make_row(binned(crossing(), as_logged=False), against)

    for protocol in PROTOCOLS:
        for name in ("entry_rate", "exit_rate"):  # The pedestrian, and the cyclist.
            assert row.numbers[f"{protocol.name}/{name}"] == 1 / 8
            np.testing.assert_array_equal(row.curves[f"{protocol.name}/{name}"], [1 / 8])
        # The pedestrian, the only inserted agent, walks off the road; others stay on it.
        assert row.numbers[f"{protocol.name}/inserted_offroad_rate"] == 1
        assert row.numbers[f"{protocol.name}/offroad_rate"] < 1


def test_who_comes_from_afar_counts_for_one_protocol_only(crossing, against):
    far = np.full(1, 90, np.float32)
    one = replace(binned(crossing(), as_logged=False), entry_distance_m=far)

    row = make_row(one, against)

    rates = [row.numbers[f"{each}/entry_rate"] for each in ("paper", "corrected")]
    assert rates == [1 / 8, 0]


def test_a_long_log_knows_the_truth_of_later_windows(crossing, against):
    number = np.ones(187, np.int16)
    logs = {"made": LogCounts(number, 2 * number)}
    known = replace(against, logs=logs)
    one = replace(binned(crossing(), as_logged=False), scenario_id="made")

    row = make_row(one, known)
    assert row.numbers["ace/truth_near"] == pytest.approx(
        abs(row.numbers["agents/near"] - 1)
    )


def test_a_rollout_whose_log_is_not_known_has_no_count_error(crossing, against):
    row = make_row(replace(binned(crossing()), scenario_id="unknown"), against)

    assert np.isnan(row.numbers["ace/own_near"])
    assert row.numbers["ace/split_near"] > 0


def test_turning_and_moving_the_scene_changes_no_score(crossing, against):
    scene = crossing(speed_mps=9.3)
    # Boxes of 2 m, 3 m from the edge, stand on the edge of a bin.
    scene = replace(scene, tracks=_longer(scene.tracks, 0.0, wider_m=0.3))
    turned = _turned(scene, 0.6, (40.0, -30.0))

    one, two = (
        score_binned(binned(s, as_logged=False), against.log_p, cut_windows(80, 8.0, 0.5))
        for s in (scene, turned)
    )
    np.testing.assert_allclose(one.overall, two.overall, atol=5e-3)


def _turned(scene, angle, shift):
    cos, sin = np.cos(angle), np.sin(angle)

    def turn(xyz):
        x, y, z = np.moveaxis(xyz, -1, 0)
        moved = cos * x - sin * y + shift[0], sin * x + cos * y + shift[1], z
        return np.stack(moved, axis=-1).astype(np.float32)

    tracks = replace(
        scene.tracks,
        xyz_m=turn(scene.tracks.xyz_m),
        heading_rad=(scene.tracks.heading_rad + np.float32(angle)).astype(np.float32),
    )
    road_map = replace(scene.road_map, xyz_m=turn(scene.road_map.xyz_m))
    return replace(scene, tracks=tracks, road_map=road_map)
