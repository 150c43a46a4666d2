"""The example planner drives along its lane, brakes, and the others live their lives."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from infgen.config import RolloutSettings
from infgen.scene import Scene
from pipeline.storage.scenes import SCENES_SCHEMA
from pipeline.storage.weights import save_network, state_dict_of
from pipeline.storage.zarr_store import write_records

EXAMPLES = Path(__file__).parents[2] / "examples"
ALONE = RolloutSettings(insert=False, remove=False, max_agents=8)


@pytest.fixture
def planner(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("planner")


@pytest.fixture
def street(planner):
    return importlib.import_module("street")


def test_the_planner_drives_along_its_lane(planner, street):
    simulator = planner.make_player(street.fresh_network(), ALONE)

    # All others are far ahead and beside: a free road.
    start = planner.begin(street.street((8.0,)), simulator)
    moments = list(planner.drive(simulator, start, 4.0))

    poses = np.array([moment.ego_pose for moment in moments])
    assert (np.diff(poses[:, 0]) > 3.5).all()
    np.testing.assert_allclose(poses[:, 1], 0, atol=1e-3)
    assert 8.0 < moments[-1].speed_mps < 12.0
    assert moments[-1].seconds == 4.0


def test_the_planner_comes_back_to_the_middle_of_its_lane(planner, street):
    scene = street.street((8.0,))
    scene.tracks.xyz_m[0, :, 1] = 1.0
    keeper = planner.LaneKeeper.of(scene, desired_mps=8.0)
    assert keeper.aside_m == pytest.approx(1.0, abs=1e-4)

    paths = [keeper.plan(np.inf, 0.0) for _ in range(10)]

    asides_m = [path[-1, 1] for path in paths]
    assert asides_m == sorted(asides_m, reverse=True)
    assert asides_m[-1] < 0.1


def test_the_planner_stops_behind_who_stands(planner, street):
    keeper = planner.LaneKeeper.of(street.street((8.0,)), desired_mps=12.0)
    gap_m = 60.0
    for _ in range(60):
        driven_m = keeper.at_m
        keeper.plan(gap_m, keeper.speed_mps)
        gap_m -= keeper.at_m - driven_m

    assert keeper.speed_mps < 0.3
    assert 0.5 < gap_m < 5.0


def test_the_planner_plays_a_logged_scene_with_given_weights(
    planner, street, tmp_path, capsys, crossing
):
    network = street.fresh_network(seed=3)
    save_network(tmp_path, network, state_dict_of(network), step=1)
    write_records(
        tmp_path / "scenes-000.zarr", [crossing()], Scene, SCENES_SCHEMA, compress=True
    )
    words = f"--weights {tmp_path} --scenes {tmp_path} --seconds 1"

    planner.main(words.split())

    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 2
    assert lines[-1].split()[0] == "1.0"
