import numpy as np
import pytest

from infgen.config import TokenSettings, VocabSettings
from infgen.scene import AgentType
from infgen.tokens.clustering.coverage import (
    Matches,
    describe_map,
    describe_motion,
    match_paths,
)
from infgen.tokens.clustering.vocabularies import Origin
from infgen.tokens.tracks import read_paths

SETTINGS = VocabSettings()
NOTHING = Matches(np.empty(0, np.int8), np.empty(0, int), np.empty(0))


def paths_of(*scenes):
    return [read_paths(scene, TokenSettings()) for scene in scenes]


def origins(vocabulary):
    return np.full(vocabulary.real.shape, Origin.LOGGED, np.int8)


def test_a_drive_the_codebook_can_write_has_no_error(drive, metre_moves):
    found = match_paths(paths_of(drive(speed_mps=10.0)), metre_moves)
    assert len(found.motion_token) == 17  # the first half second is the entry
    np.testing.assert_array_equal(found.motion_token, 5)
    np.testing.assert_allclose(found.error_m, 0, atol=1e-4)


def test_the_error_is_that_of_the_chain_of_moves(drive, metre_moves):
    found = match_paths(paths_of(drive(speed_mps=9.0)), metre_moves)  # 4.5 m a token
    assert set(found.motion_token) == {4, 5}
    np.testing.assert_allclose(found.error_m.max(), 0.5, atol=1e-3)
    assert found.error_m.mean() == pytest.approx(0.5 * 9 / 17, abs=0.02)


def test_no_scenes_have_no_matches(metre_moves):
    assert len(match_paths([], metre_moves).motion_token) == 0


def test_the_report_of_moves_counts_what_was_used_on_either_side(drive, metre_moves):
    validation_split = match_paths(paths_of(drive(speed_mps=10.0)), metre_moves)
    familiar = match_paths(paths_of(drive(speed_mps=12.0)), metre_moves)
    report = describe_motion(
        metre_moves, origins(metre_moves), validation_split, familiar, SETTINGS
    )
    vehicle = report["vehicle"]
    assert vehicle["dead"] == 61 - 2
    assert vehicle["held_out_tokens"] == 17
    assert vehicle["held_out_error_m"]["mean"] == pytest.approx(0, abs=1e-4)
    assert (vehicle["real"], vehicle["mirrored"], vehicle["made"]) == (61, 0, 0)
    assert vehicle["speed_mps"]["max"] == 40.0
    assert vehicle["turn_deg"] == {"min": -10.0, "p50": 0.0, "max": 10.0}
    assert (vehicle["left"], vehicle["right"]) == (20, 20)
    assert vehicle["mirror_gap_m"]["max"] == pytest.approx(0, abs=1e-6)
    # Turned by 10 degrees without going aside: beyond 3.44 m that is a slip of 0.3 m.
    assert vehicle["beyond_limits"] == 2 * 17
    assert report["pedestrian"]["beyond_limits"] > 0  # 40 m/s on foot
    assert report["cyclist"]["held_out_error_m"] is None


def test_errors_of_who_moves_are_told_apart_from_those_of_who_stands(metre_moves):
    kinds = np.zeros(4, np.int8)
    matches = Matches(kinds, np.array([0, 0, 0, 7]), np.array([0.0, 0.0, 0.0, 0.4]))
    report = describe_motion(metre_moves, origins(metre_moves), matches, NOTHING, SETTINGS)
    assert report["vehicle"]["held_out_error_m"]["mean"] == 0.1
    assert report["vehicle"]["held_out_error_moving_m"]["mean"] == 0.4


def test_what_rows_are_made_from_is_counted(metre_moves):
    origin = origins(metre_moves)
    origin[AgentType.CYCLIST, :10] = Origin.MADE
    origin[AgentType.CYCLIST, 10:15] = Origin.MIRRORED
    report = describe_motion(metre_moves, origin, NOTHING, NOTHING, SETTINGS)["cyclist"]
    assert (report["real"], report["mirrored"], report["made"]) == (46, 5, 10)


def test_the_report_of_roads_measures_how_far_middle_and_end_are_from_the_log(bent_roads):
    origin = np.full(9, Origin.LOGGED, np.int8)
    exact = bent_roads.curve_m[[0, 3, 3]]
    report = describe_map(bent_roads, origin, exact, bent_roads.curve_m[:1])
    assert report["dead"] == 7
    assert report["held_out_error_m"]["max"] == 0
    assert report["length_m"]["p50"] == pytest.approx(5.0, abs=1e-3)
    assert report["turn_deg"]["max"] == pytest.approx(40.0, abs=0.01)
    assert (report["left"], report["right"]) == (4, 4)
    off = exact + np.float32([0, 0.1])
    report = describe_map(bent_roads, origin, off, off[:0])
    assert 0 < report["held_out_error_m"]["mean"] <= 0.1 + 1e-5


def test_without_held_out_pieces_there_is_no_error_of_roads(bent_roads):
    none = np.empty((0, 11, 2), np.float32)
    report = describe_map(bent_roads, np.full(9, Origin.MADE, np.int8), none, none)
    assert report["held_out_error_m"] is None
    assert report["dead"] == 9
