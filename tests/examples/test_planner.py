"""The example planner drives along its lane, brakes, and the others live their lives."""

import importlib
from pathlib import Path

import numpy as np
import pytest

import infgen

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def planner(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("planner")


@pytest.fixture
def street(planner):
    return importlib.import_module("street")


def test_the_planner_drives_along_its_lane(planner, street):
    sim = infgen.load("towns", insert=False, remove=False, max_agents=8)

    # All others are far ahead and beside: a free road.
    scene = street.street((8.0,))
    moments = list(planner.drive(sim.session(scene), scene, 4.0))

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


def test_the_planner_drives_a_scene_of_the_package_and_shows_it(planner, tmp_path, capsys):
    page = tmp_path / "drive.html"

    planner.main(["--seconds", "1", "--page", str(page)])

    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 2 + 1
    assert lines[2].split()[0] == "1.0"
    assert lines[-1] == str(page)
    assert "rollout 0" in page.read_text()


def test_the_street_is_simulated_and_shown(street, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    street.main()

    assert capsys.readouterr().out == "street.html\n"
    assert "rollout 1" in (tmp_path / "street.html").read_text()
