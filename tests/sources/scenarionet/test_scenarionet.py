import copy
import pickle

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from infgen.scene import AgentType, FeatureType, RoadEdgeType, Scene, SignalState
from infgen.sources import scenarionet
from infgen.sources.scene_files import SceneFiles
from infgen.sources.tfrecord import RecordError
from infgen.spatial.road_edges import scene_road_edges, signed_distance_m

STEPS = 30


def track(kind="VEHICLE", x_m=0.0, **state):
    states = {
        "position": np.column_stack(
            [x_m + 0.5 * np.arange(STEPS), np.zeros(STEPS), np.ones(STEPS)]
        ),
        "heading": np.zeros(STEPS),
        "velocity": np.tile([5.0, 0.0], (STEPS, 1)),
        "valid": np.ones(STEPS),
        "length": np.full((STEPS, 1), 4.5),
        "width": np.full((STEPS, 1), 2.0),
        "height": np.full((STEPS, 1), 1.5),
    }
    return {"type": kind, "state": states | state, "metadata": {}}


def ring(low_m, high_m, turn=1):
    """A closed square; counter-clockwise if ``turn`` is 1."""
    (a, b), (c, d) = (low_m, low_m), (high_m, high_m)
    return np.array([(a, b), (c, b), (c, d), (a, d), (a, b)])[::turn]


def description(dataset="nuscenes", **changes):
    """What ScenarioNet makes of a nuScenes scene, small."""
    lane = [(x, 0.0, 1.57) for x in np.arange(-20.0, 21.0)]
    found = {
        "id": "scene-0001",
        "version": "nuscenesv1.0-trainval",
        "length": STEPS,
        "metadata": {
            "dataset": dataset,
            "scenario_id": "scene-0001",
            "sdc_id": "ego",
            "ts": 0.1 * np.arange(STEPS),
            "coordinate": "right-handed",
        },
        "tracks": {
            "ego": track(length=np.full((STEPS, 1), 1.73), width=np.full((STEPS, 1), 4.08)),
            "a1b2": track("PEDESTRIAN", 10.0),
            "cone": track("TRAFFIC_CONE", 20.0),
        },
        "dynamic_map_states": {},
        "map_features": {
            "boundary_0": {
                "type": "ROAD_LINE_SOLID_SINGLE_WHITE",
                "polyline": ring(-40, 40, -1),
            },
            "boundary_1": {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": ring(8, 12)},
            "lane-a": {
                "type": "LANE_SURFACE_STREET",
                "polyline": lane,
                "speed_limit_kmh": 100,
            },
            "line-a": {
                "type": "ROAD_LINE_BROKEN_SINGLE_WHITE",
                "polyline": [[0.0, 3.0], [10.0, 3.0]],
            },
        },
    }
    return found | changes


def read(found, tmp_path, name="sd_x.pkl", now=None):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(found if isinstance(found, bytes) else pickle.dumps(found))
    files = SceneFiles(name, (str(path),))
    return scenarionet.read(files, now), scenarionet.label(files)


@pytest.fixture
def nuscenes(tmp_path) -> Scene:
    return read(description(), tmp_path)[0].scene


def test_tracks_have_types_ids_and_the_box_of_each_step(nuscenes):
    tracks = nuscenes.tracks

    assert tracks.agent_type.tolist() == [
        AgentType.VEHICLE,
        AgentType.PEDESTRIAN,
        AgentType.OTHER,
    ]
    assert sorted(tracks.id.tolist()) == [0, 1, 2]
    assert tracks.size_lwh_m[1, 3].tolist() == pytest.approx([4.5, 2.0, 1.5])
    world_m = nuscenes.tracks.xyz_m[1, 4] + nuscenes.origin_xyz_m
    assert world_m.tolist() == [12.0, 0.0, 1.0]


def test_length_and_width_of_the_ego_of_nuscenes_are_exchanged_back(nuscenes):
    assert nuscenes.tracks.size_lwh_m[nuscenes.ego, 0].tolist() == pytest.approx(
        [4.08, 1.73, 1.5]
    )


def test_the_third_coordinate_of_a_nuscenes_lane_is_no_height(nuscenes):
    (lane,) = nuscenes.road_map.rows(FeatureType.LANE)

    world_m = nuscenes.road_map.points(int(lane)) + nuscenes.origin_xyz_m
    assert (world_m[:, 2] == 0).all()
    assert nuscenes.road_map.speed_limit_mph[lane] == 0  # Says 100 km/h everywhere.


def test_outlines_are_road_edges_with_the_road_on_their_left(nuscenes):
    road_map = nuscenes.road_map
    kinds = road_map.feature_subtype[road_map.rows(FeatureType.ROAD_EDGE)]
    points_m = np.array([[0, 5, 0], [10, 10, 0], [45, 5, 0], [39, 5, 0]], np.float32)
    local_m = points_m - np.array([*nuscenes.origin_xyz_m[:2], 0], np.float32)

    assert set(kinds.tolist()) == {RoadEdgeType.BOUNDARY, RoadEdgeType.MEDIAN}
    off_road_m = signed_distance_m(local_m, scene_road_edges(nuscenes, flat=True))
    assert off_road_m == pytest.approx([-(73**0.5), 2.0, 5.0, -1.0], abs=1e-3)
    assert (off_road_m > 0).tolist() == [False, True, True, False]


def test_lines_are_made_dense_enough_for_map_tokens(nuscenes):
    (line,) = nuscenes.road_map.rows(FeatureType.ROAD_LINE)

    gaps_m = np.linalg.norm(np.diff(nuscenes.road_map.points(int(line)), axis=0), axis=1)
    assert len(gaps_m) == 10
    np.testing.assert_allclose(gaps_m, 1.0, rtol=1e-5)


def test_the_report_says_that_steps_are_interpolated(tmp_path):
    assert read(description(), tmp_path)[0].annotation_hz == 2
    assert read(description("waymo"), tmp_path)[0].annotation_hz == 10


@pytest.mark.parametrize(
    ("changes", "name", "split"),
    [
        ({}, "sd_x.pkl", "nuscenes"),
        ({}, "nuscenes_train/sd_x.pkl", "training"),
        ({}, "val/deep/sd_x.pkl", "validation"),
        ({"version": "nuscenesv1.0-mini"}, "train/sd_x.pkl", "training"),
        (
            {
                "version": "nuscenesv1.0-mini",
                "metadata": description()["metadata"] | {"scenario_id": "scene-0103"},
            },
            "sd_x.pkl",
            "validation",
        ),
        (
            {
                "metadata": description("waymo")["metadata"]
                | {"source_file": "validation.tfrecord-00000-of-00150"}
            },
            "train/sd_x.pkl",
            "validation",
        ),
    ],
)
def test_the_split_is_the_records_own_or_that_of_its_folder(
    changes, name, split, tmp_path_factory
):
    folder = tmp_path_factory.mktemp("x")

    assert read(description(**changes), folder, name)[1].split == split


def test_now_is_the_descriptions_own_unless_one_is_asked_for(tmp_path):
    about = description()["metadata"] | {"current_time_index": 20}

    assert read(description(), tmp_path)[0].scene.now == 10
    assert read(description(metadata=about), tmp_path)[0].scene.now == 20
    assert read(description(metadata=about), tmp_path, now=15)[0].scene.now == 15


def test_nuplan_names_neighbours_links_and_colours(tmp_path):
    lane = description()["map_features"]["lane-a"]
    features = {
        "7": lane | {"exit_lanes": ["8"], "left_neighbor": ["8"]},
        "8": lane | {"entry_lanes": [7]},
    }
    lights = {
        "8": {
            "type": "TRAFFIC_LIGHT",
            "state": {"object_state": ["TRAFFIC_LIGHT_RED"] * 20 + [None] * 10},
            "lane": "8",
            "stop_point": None,
        }
    }
    found = description("nuplan", map_features=features, dynamic_map_states=lights)
    scene = read(found, tmp_path)[0].scene

    assert scene.road_map.link_lane_id.tolist() == [7, 8]
    assert scene.road_map.link_other_id.tolist() == [8, 7]
    assert scene.road_map.neighbour_other_id.tolist() == [8]
    assert len(scene.signals.step) == 20
    assert set(scene.signals.state.tolist()) == {SignalState.STOP}


def without(*path):
    found = copy.deepcopy(description())
    owner = found
    for name in path[:-1]:
        owner = owner[name]
    del owner[path[-1]]
    return found


BAD = {
    "no ego": (without("metadata", "sdc_id"), "ego"),
    "no metadata": (without("metadata"), "metadata"),
    "no positions": (without("tracks", "a1b2", "state", "position"), "no position"),
    "no tracks": (description(tracks={}), "ego|no tracks"),
    "a table": ({"a.pkl": {"dataset": "nuscenes"}}, "holds no scene"),
    "a list": ([1, 2], "not a scene's dictionary"),
    "too few states": (
        description(tracks={"ego": track(heading=np.zeros(5))}),
        "heading of shape",
    ),
    "not finite": (
        description(tracks={"ego": track(heading=np.full(STEPS, np.nan))}),
        "not finite",
    ),
    "two hertz": (
        description(metadata=description()["metadata"] | {"ts": 0.5 * np.arange(STEPS)}),
        "0.5 s apart",
    ),
    "a line without end": (
        description(
            map_features={
                "1": {"type": "LANE_SURFACE_STREET", "polyline": [[0.0, 0], [1e12, 0]]}
            }
        ),
        "m long",
    ),
    "damaged": (pickle.dumps(description())[:-100], "not a usable pickle"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_scene_is_refused_with_the_reason(name, tmp_path):
    found, reason = BAD[name]

    with pytest.raises(RecordError, match=reason):
        read(found, tmp_path)


def check_reason(error):
    assert str(error)


SOUND = pickle.dumps(description(), 4)


FEW = settings(max_examples=40, phases=[Phase.explicit, Phase.generate])


@FEW
@given(at=st.integers(0, len(SOUND) - 1), bits=st.integers(1, 255))
def test_a_changed_byte_gives_a_scene_or_a_reason(at, bits, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "fuzz"
    data = SOUND[:at] + bytes([SOUND[at] ^ bits]) + SOUND[at + 1 :]
    try:
        scene = read(data, folder)[0].scene
    except RecordError as error:
        check_reason(error)
        return
    assert np.isfinite(scene.tracks.xyz_m).all()
    assert np.isfinite(scene.road_map.xyz_m).all()


def test_true_is_no_step(tmp_path):
    about = description()["metadata"] | {"current_time_index": True}

    assert read(description(metadata=about), tmp_path)[0].scene.now == 10


LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
    st.lists(st.floats(), max_size=3), st.just({}), st.just(np.zeros((2, 2), "U3")),
)  # fmt: skip


@FEW
@given(
    path=st.sampled_from(
        [
            ("length",), ("metadata", "ts"), ("metadata", "current_time_index"),
            ("metadata", "tracks_to_predict"), ("metadata", "objects_of_interest"),
            ("tracks", "ego", "state"), ("tracks", "ego", "state", "valid"),
            ("tracks", "a1b2", "type"), ("map_features", "lane-a", "polyline"),
            ("map_features", "lane-a", "type"), ("map_features", "line-a"),
            ("map_features", "boundary_0", "polyline"), ("dynamic_map_states",),
            ("metadata", "infgen_origin_xyz_m"),
            ("map_features", "lane-a", "left_neighbor"),
        ]
    ),
    value=LEAVES,
)  # fmt: skip
def test_any_value_in_any_place_gives_a_scene_or_a_reason(path, value, tmp_path_factory):
    found = copy.deepcopy(description())
    owner = found
    for name in path[:-1]:
        owner = owner[name]
    owner[path[-1]] = value
    try:
        read(found, tmp_path_factory.getbasetemp() / "leaf")
    except RecordError as error:
        check_reason(error)
