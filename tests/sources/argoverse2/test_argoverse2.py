import dataclasses
import io
import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from infgen.scene import AgentType, FeatureType, LaneType, LinkType, RoadLineType, Side
from infgen.sources import argoverse2
from infgen.sources.argoverse2.poses import Poses, rotations
from infgen.sources.tfrecord import RecordError
from infgen.spatial.road_edges import scene_road_edges, signed_distance_m

FEW = settings(max_examples=12, phases=[Phase.explicit, Phase.generate])


def files_in(folder):
    names = sorted(path.name for path in folder.iterdir() if path.is_file())
    (found,) = argoverse2.find(folder, names)
    return found


@pytest.fixture
def motion(tmp_path, made, crossing):
    scene = dataclasses.replace(crossing(steps=110), now=49)
    made.write_motion(tmp_path / "val" / "m-1", scene)
    return tmp_path / "val" / "m-1", scene


@pytest.fixture
def sensor(tmp_path, made, crossing):
    made.write_sensor(tmp_path / "train" / "log-1", crossing(steps=60))
    return tmp_path / "train" / "log-1", crossing(steps=60)


def world_m(scene):
    return scene.tracks.xyz_m + scene.origin_xyz_m


def test_a_motion_scenario_has_the_tracks_that_were_written(motion):
    folder, scene = motion
    read = argoverse2.read(files_in(folder), None)
    found, valid = read.scene, scene.tracks.valid

    assert (read.dataset, found.scenario_id, found.now) == ("av2-motion", "m-1", 49)
    assert found.tracks.num_steps == 110
    np.testing.assert_array_equal(found.tracks.valid, valid)
    np.testing.assert_allclose(
        world_m(found)[valid][:, :2], world_m(scene)[valid][:, :2], atol=1e-3
    )
    np.testing.assert_allclose(
        found.tracks.heading_rad, scene.tracks.heading_rad, atol=1e-6
    )
    assert found.tracks.id.tolist() == [0, 101, 102, 103]  # AV has no number of its own.
    assert found.tracks.agent_type.tolist() == scene.tracks.agent_type.tolist()
    assert found.ego == 0
    assert found.predict_row.tolist() == [0]


def test_boxes_of_motion_stand_on_the_ground_of_the_map(motion):
    scene = argoverse2.read(files_in(motion[0]), None).scene
    pedestrian = scene.tracks.agent_type.tolist().index(AgentType.PEDESTRIAN)

    z_m = world_m(scene)[pedestrian, 50, 2]
    assert z_m - scene.tracks.size_lwh_m[pedestrian, 50, 2] / 2 == pytest.approx(10.0)


def test_a_sensor_log_is_brought_from_the_ego_to_the_city_frame(sensor):
    folder, scene = sensor
    read = argoverse2.read(files_in(folder), None)
    found = read.scene
    valid = scene.tracks.valid

    assert (read.dataset, found.scenario_id, found.now) == ("av2-sensor", "log-1", 10)
    np.testing.assert_array_equal(found.tracks.valid, valid)
    np.testing.assert_allclose(world_m(found)[valid], world_m(scene)[valid], atol=1e-3)
    np.testing.assert_allclose(
        np.cos(found.tracks.heading_rad - scene.tracks.heading_rad)[valid], 1, atol=1e-6
    )
    np.testing.assert_allclose(
        found.tracks.velocity_mps[valid], scene.tracks.velocity_mps[valid], atol=2e-3
    )


def test_steps_between_sweeps_are_interpolated_and_long_gaps_are_not(sensor):
    """Sweeps 20 ms late, and four of them missing."""
    folder, scene = sensor
    path = folder / "annotations.feather"
    table = pl.read_ipc(path)
    first = table["timestamp_ns"].min()
    number = (pl.col("timestamp_ns") - first) // 100_000_000
    car = pl.col("track_uuid") == "track-101"
    late = table.filter(~(car & number.is_between(20, 23)))
    moved = pl.when(car & (number > 0)).then(20_000_000).otherwise(0)
    # The boxes are where they were, but at another time: the car is that much slower.
    late.with_columns(timestamp_ns=pl.col("timestamp_ns") + moved).write_ipc(path)

    found = argoverse2.read(files_in(folder), None).scene
    assert (~found.tracks.valid[1]).nonzero()[0].tolist() == [20, 21, 22, 23]
    np.testing.assert_allclose(
        world_m(found)[1, 30:40, 1], world_m(scene)[1, 30:40, 1] - 0.2, atol=1e-3
    )


def test_lanes_have_relations_types_and_lines(motion):
    road_map = argoverse2.read(files_in(motion[0]), None).scene.road_map
    kinds = dict(zip(*np.unique(road_map.feature_type, return_counts=True), strict=True))

    assert kinds == {
        FeatureType.LANE: 2,
        FeatureType.ROAD_LINE: 2,  # The middle one is shared.
        FeatureType.ROAD_EDGE: 4,
        FeatureType.CROSSWALK: 1,
    }
    assert road_map.feature_id[:2].tolist() == [11, 12]
    assert road_map.feature_subtype[:2].tolist() == [
        LaneType.SURFACE_STREET,
        LaneType.BIKE_LANE,
    ]
    assert (road_map.speed_limit_mph == 0).all()
    assert road_map.link_type.tolist() == [LinkType.EXIT]
    assert (road_map.link_lane_id[0], road_map.link_other_id[0]) == (11, 13)
    assert road_map.neighbour_lane_id.tolist() == [11, 12]
    assert road_map.neighbour_side.tolist() == [Side.LEFT, Side.RIGHT]
    assert road_map.boundary_lane_id.tolist() == [11, 12, 12]
    assert road_map.boundary_type.tolist() == [
        RoadLineType.BROKEN_SINGLE_WHITE,
        RoadLineType.SOLID_SINGLE_YELLOW,
        RoadLineType.BROKEN_SINGLE_WHITE,
    ]
    assert road_map.boundary_feature_id[0] == road_map.boundary_feature_id[2]


def test_a_lane_that_runs_the_other_way_is_no_neighbour(motion):
    folder, _ = motion
    (path,) = folder.glob("*.json")
    archive = json.loads(path.read_text())
    for side in ("left", "right"):
        archive["lane_segments"]["12"][f"{side}_lane_boundary"].reverse()
    path.write_text(json.dumps(archive))

    assert len(argoverse2.read(files_in(folder), None).scene.road_map.neighbour_side) == 0


def test_lanes_lie_between_their_boundaries_and_on_the_road(motion):
    scene = argoverse2.read(files_in(motion[0]), None).scene
    edges = scene_road_edges(scene)
    local_m = np.array([1000, -2000, 10], np.float32) - scene.origin_xyz_m.astype(
        np.float32
    )
    beside_m = (
        np.array([[0, 0, 0], [0, -3, 0], [0, 7, 0], [590, 0, 0]], np.float32) + local_m
    )

    (first, _) = scene.road_map.rows(FeatureType.LANE).tolist()
    np.testing.assert_allclose(scene.road_map.points(first)[:, 1], local_m[1], atol=1e-4)
    # Two metres from the edge, one beyond it on either side; where the map ends, no edge.
    off_road_m = signed_distance_m(beside_m, edges)
    np.testing.assert_allclose(off_road_m[:3], [-2, 1, 1.5], atol=1e-3)
    assert off_road_m[3] < 0


def test_quaternions_turn_as_they_should():
    half = np.sqrt(0.5)
    turned = rotations(np.array([(1.0, 0, 0, 0), (half, 0, 0, half), (2, 0, 0, 2)]))

    np.testing.assert_allclose(turned[1] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned[2], turned[1], atol=1e-12)


def test_poses_are_interpolated_the_shorter_way():
    half = np.sqrt(0.5)
    # A quarter turn, its quaternion with the other sign.
    poses = Poses(
        np.array([0, 100]),
        np.array([(1.0, 0, 0, 0), (-half, 0, 0, -half)]),
        np.array([(0.0, 0, 0), (2, 0, 0)]),
    )
    middle = poses.at(np.array([50, 500]))

    np.testing.assert_allclose(middle.xyz_m[:, 0], [1, 2])
    np.testing.assert_allclose(
        middle.headings(np.tile([1.0, 0, 0], (2, 1))), [np.pi / 4, np.pi / 2], atol=1e-9
    )


def test_now_is_the_one_that_is_asked_for(motion):
    assert argoverse2.read(files_in(motion[0]), 10).scene.now == 10
    with pytest.raises(RecordError, match="current step 110 is not one of the 110"):
        argoverse2.read(files_in(motion[0]), 110)


def test_the_split_is_that_of_the_folder(motion, sensor, tmp_path):
    assert argoverse2.label(files_in(motion[0])) == ("validation", "m-1")
    assert argoverse2.label(files_in(sensor[0])) == ("training", "log-1")
    elsewhere = tmp_path / "a" / "b" / "m-1"
    shutil.copytree(motion[0], elsewhere)
    assert argoverse2.label(files_in(elsewhere)).split == "argoverse2"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("annotations.feather", "no annotations"),
        ("city_SE3_egovehicle.feather", "no city_SE3"),
        ("map", "no map archive"),
    ],
)
def test_a_log_that_lacks_a_file_says_which(sensor, name, reason):
    folder, _ = sensor
    path = folder / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()

    with pytest.raises(RecordError, match=reason):
        argoverse2.read(files_in(folder), None)


def table_bytes(table, kind):
    out = io.BytesIO()
    table.write_parquet(out) if kind == "parquet" else table.write_ipc(out)
    return out.getvalue()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.drop("heading"), "not a usable Parquet table"),
        (lambda t: t.filter(pl.col("track_id") != "AV"), "no track 'AV'"),
        (lambda t: pl.concat([t, t]), "two states at one step"),
        (lambda t: t.with_columns(timestep=pl.lit(-1)), "timesteps run from -1"),
        (lambda t: t.with_columns(position_x=pl.lit(float("nan"))), "not finite"),
        (lambda t: t.with_columns(timestep=pl.lit("a")), "column timestep is of type"),
        (lambda t: t.with_columns(heading=pl.lit(None, pl.Float64)), "missing values"),
        (lambda t: t.clear(), "0 rows"),
    ],
)
def test_a_table_that_is_none_of_tracks_says_why(motion, change, reason):
    folder, _ = motion
    (path,) = folder.glob("*.parquet")
    path.write_bytes(table_bytes(change(pl.read_parquet(path)), "parquet"))

    with pytest.raises(RecordError, match=reason):
        argoverse2.read(files_in(folder), None)


MAPS = {
    "no JSON": "{",
    "a list": "[]",
    "nested without end": "[" * 100_000,
    "no points": '{"lane_segments": {"1": {"id": 1}}}',
    "a number": '{"lane_segments": 3}',
    "no id": '{"lane_segments": {"1": {}}}',
}


@pytest.mark.parametrize("name", MAPS)
def test_a_map_that_is_none_is_refused(motion, name):
    folder, _ = motion
    (path,) = folder.glob("*.json")
    path.write_text(MAPS[name])

    with pytest.raises(RecordError, match="map archive"):
        argoverse2.read(files_in(folder), None)


@pytest.fixture(scope="module")
def folders_of_bytes(tmp_path_factory, made, crossing):
    """The files of a sensor log, and of a motion scenario."""
    folder = tmp_path_factory.mktemp("av2")
    made.write_sensor(folder / "log", crossing(steps=30))
    made.write_motion(folder / "m", dataclasses.replace(crossing(steps=60), now=49))
    return [
        [Path(path).read_bytes() for path in files_in(folder / name).paths]
        for name in ("log", "m")
    ]


def check_reason(error):
    assert str(error)


@FEW
@given(
    which=st.sampled_from(["annotations", "poses", "map", "table"]),
    spots=st.lists(st.tuples(st.floats(0, 1), st.integers(1, 255)), min_size=1, max_size=4),
    cut=st.none() | st.floats(0, 1),
)
def test_damaged_files_give_a_scene_or_a_reason(folders_of_bytes, which, spots, cut):
    log, scenario = folders_of_bytes
    at = {"annotations": 0, "poses": 1, "map": 2, "table": 0}[which]
    blobs = list(scenario if which == "table" else log)
    data = bytearray(blobs[at])
    for share, bits in spots:
        data[int(share * (len(data) - 1))] ^= bits
    blobs[at] = bytes(data[: int(cut * len(data))] if cut is not None else data)
    try:
        if which == "table":
            scene = argoverse2.decode_motion(blobs[0], blobs[1]).scene
        else:
            scene = argoverse2.decode_sensor("x", *blobs).scene
    except RecordError as error:
        check_reason(error)
        return
    assert np.isfinite(scene.tracks.xyz_m).all()
    assert np.isfinite(scene.road_map.xyz_m).all()
