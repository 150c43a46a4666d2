"""Against the real scenes of Argoverse 2 and ScenarioNet that lie beside the checkout."""

import numpy as np
import pytest

from infgen.alignment import align_to_tokens
from infgen.config import TokenSettings
from infgen.exports.scenarionet_scene import describe_scene
from infgen.scene import AgentType, FeatureType, Scene
from infgen.sources import scenarionet
from infgen.sources.registry import find_below
from infgen.sources.scenarionet.pickles import pickled, unpickle
from infgen.sources.womd import iter_scenes
from infgen.spatial.road_edges import scene_road_edges, signed_distance_m
from infgen.tokens.sequence import decode_sequence
from infgen.tokens.tokenizer import tokenize_scene
from tests.sources.records import SHARED
from tests.sources.test_womd import differences
from tests.tokens.test_sequence import agent_matrix, assert_same, stream_alone

FOLDERS = [SHARED.parent / "av2", SHARED.parent / "scenarionet"]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not all(folder.is_dir() for folder in FOLDERS),
        reason="needs the shared scenes (../shared/data/av2 and scenarionet)",
    ),
]
FOUND = [
    found for folder in FOLDERS if folder.is_dir() for found in find_below(str(folder))
]
TWINS = {"2a1e44d405a6833f": "00007", "8a346109094cd5aa": "00008"}
"""Scenes of WOMD that are there both ways, and the TFRecord they are in."""
MOVING_MPS = 3.0


@pytest.fixture(scope="module", params=FOUND, ids=lambda found: found.files.name[-36:])
def read(request):
    return request.param.read()


@pytest.fixture(scope="module")
def scene(read) -> Scene:
    return read.scene


def flat(points_m):
    return (points_m * np.array([1, 1, 0])).astype(np.float32)


def lanes_of(scene):
    road_map = scene.road_map
    return [road_map.points(row) for row in road_map.rows(FeatureType.LANE).tolist()]


def moving_cars(scene):
    """Places and headings of vehicles that drive, where the map reaches."""
    tracks = scene.tracks
    speed_mps = np.linalg.norm(tracks.velocity_mps, axis=-1)
    cars = (tracks.agent_type == AgentType.VEHICLE)[:, None] & (speed_mps > MOVING_MPS)
    places_m, heading_rad = (
        tracks.xyz_m[cars & tracks.valid],
        tracks.heading_rad[cars & tracks.valid],
    )
    return flat(places_m), heading_rad


def nearest_lane(scene, places_m):
    """Distance to the nearest point of a lane, and its direction there."""
    lanes = lanes_of(scene)
    points_m = np.concatenate([lane[:-1, :2] for lane in lanes])
    ahead_m = np.concatenate([np.diff(lane[:, :2], axis=0) for lane in lanes])
    gap_m2 = ((places_m[:, None, :2] - points_m) ** 2).sum(axis=-1)
    nearest = gap_m2.argmin(axis=1)
    return np.sqrt(gap_m2.min(axis=1)), np.arctan2(*ahead_m[nearest].T[::-1])


def test_lanes_lie_on_the_road(scene):
    points_m = flat(np.concatenate(lanes_of(scene)))
    near = np.abs(points_m[:, :2]).max(axis=1) < 100

    off_road_m = signed_distance_m(points_m[near], scene_road_edges(scene, flat=True))
    assert (off_road_m < 0).mean() > 0.99


def test_the_ego_stays_on_the_road(scene):
    valid = scene.tracks.valid[scene.ego]
    places_m = flat(scene.tracks.xyz_m[scene.ego][valid])

    assert valid[scene.now]
    assert (signed_distance_m(places_m, scene_road_edges(scene, flat=True)) < -1).all()


def test_cars_drive_along_their_lanes_and_on_the_road(scene):
    """Some turn into driveways, or drive where the map has ended."""
    places_m, heading_rad = moving_cars(scene)
    gap_m, lane_rad = nearest_lane(scene, places_m[::5])
    on_lane = gap_m < 1.5
    turned = np.abs(np.exp(1j * (lane_rad - heading_rad[::5])) - 1)[on_lane]

    assert on_lane.sum() > 20
    assert np.median(turned) < 0.1  # Radians, nearly.
    assert (turned < 0.6).mean() > 0.85
    edges = scene_road_edges(scene, flat=True)
    off_road_m = signed_distance_m(places_m[::5][on_lane], edges)
    assert (off_road_m < 0).mean() > 0.95


def test_boxes_move_as_their_velocities_say(scene):
    tracks = scene.tracks
    moved_mps = (tracks.xyz_m[:, 2:, :2] - tracks.xyz_m[:, :-2, :2]) / 0.2
    seen = tracks.valid[:, 2:] & tracks.valid[:, 1:-1] & tracks.valid[:, :-2]
    gap_mps = np.linalg.norm(moved_mps - tracks.velocity_mps[:, 1:-1], axis=-1)[seen]

    assert np.median(gap_mps) < 0.3
    assert np.quantile(gap_mps, 0.9) < 1.5  # Those of motion forecasting are a tracker's.


def test_a_scene_comes_back_from_its_own_file_of_scenarionet(scene):
    found = scenarionet.decode(unpickle(pickled(describe_scene(scene)))).scene

    assert differences(found, scene) == []


def test_tokens_are_decoded_to_what_they_were(scene, dense_moves, bent_roads):
    aligned = align_to_tokens(scene)
    tokens = tokenize_scene(aligned, dense_moves, bent_roads, TokenSettings())

    decoded = decode_sequence(stream_alone(tokens), dense_moves, TokenSettings())
    assert tokens.now == aligned.now // 5 - 1
    assert tokens.motion_token.shape[1] == (aligned.tracks.num_steps - 1) // 5
    assert_same(decoded, agent_matrix(tokens))


@pytest.mark.parametrize("scenario_id", TWINS)
def test_a_scene_of_womd_is_the_same_from_tfrecord_and_from_scenarionet(scenario_id):
    """All but the times, which the pickle has in single precision."""
    (found,) = (f for f in FOUND if scenario_id in f.files.name)
    (path,) = SHARED.glob(f"training.tfrecord-{TWINS[scenario_id]}-*")
    scenes = (scene for scene in iter_scenes(path) if isinstance(scene, Scene))
    expected = next(scene for scene in scenes if scene.scenario_id == scenario_id)

    scene = found.read().scene
    assert differences(scene, expected) == ["scene.timestamps_s"]
    np.testing.assert_array_equal(
        scene.timestamps_s, expected.timestamps_s.astype(np.float32)
    )


def test_nuscenes_is_said_to_be_interpolated(read):
    assert read.annotation_hz == (2 if read.dataset == "nuscenes" else 10)
