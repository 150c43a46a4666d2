import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from infgen.rollout.rollout import NEVER, Rollout
from infgen.views.scene.picture import VIEW_PX, rollout_strip, scene_strip

SVG = "{http://www.w3.org/2000/svg}"


def looks(view):
    found = [path.get("class") for path in view.iter(f"{SVG}path")]
    return [look.removeprefix("agent ") for look in found if look.startswith("agent")]


def views(svg):
    return [view for view in ET.fromstring(svg).iter(f"{SVG}svg")][1:]


def corners(path):
    return np.array(re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", path), float)


@pytest.fixture
def rollout(drive):
    """The ego goes along +x; one agent is of the log, one came in at step 20."""
    scene = drive(speed_mps=10.0)
    tracks = scene.tracks
    rows = np.array([scene.ego] * 3)
    valid = np.ones((3, tracks.num_steps), bool)
    valid[2, :20] = False
    xyz_m = tracks.xyz_m[rows].copy()
    xyz_m[1:, :, 1] += np.array([[4.0], [8.0]], np.float32)
    return scene, Rollout(
        scenario_id=scene.scenario_id,
        index=1,
        seed=0,
        weights="none",
        origin_xyz_m=scene.origin_xyz_m,
        now=scene.now,
        ego=0,
        id=np.arange(3, dtype=np.int32),
        agent_type=np.zeros(3, np.int8),
        size_lwh_m=tracks.size_lwh_m[rows, scene.now],
        xyz_m=xyz_m,
        heading_rad=tracks.heading_rad[rows],
        valid=valid,
        logged=np.array([True, True, False]),
        entry_step=np.array([0, 0, 19], np.int16),
        exit_step=np.full(3, NEVER, np.int16),
    )


def test_a_log_is_drawn_once_per_step_with_the_ego_in_the_middle(drive):
    scene = drive(speed_mps=10.0)

    first, second = views(scene_strip(scene, [10, 90]))

    for view in (first, second):
        assert "ego" in looks(view)
        (ego,) = [p for p in view.iter(f"{SVG}path") if p.get("class") == "agent ego"]
        middle = (corners(ego.get("d")).min(axis=0) + corners(ego.get("d")).max(axis=0)) / 2
        np.testing.assert_allclose(middle, [VIEW_PX / 2] * 2, atol=0.2)


def test_agents_are_told_apart_by_how_they_came(rollout):
    scene, played = rollout

    before, after = views(rollout_strip(played, scene.road_map, [10, 30]))

    assert looks(before) == ["ego", "initial"]
    assert looks(after) == ["ego", "initial", "inserted"]


def test_a_box_points_where_its_agent_heads(rollout):
    scene, played = rollout
    up = replace(played, heading_rad=np.full_like(played.heading_rad, np.pi / 2))

    east, north = (
        corners(
            next(
                p
                for p in views(rollout_strip(each, scene.road_map, [10]))[0].iter(
                    f"{SVG}path"
                )
                if p.get("class") == "agent ego"
            ).get("d")
        )
        for each in (played, up)
    )

    # The first corner is the tip; down is positive in SVG.
    assert east[0, 0] == east[:, 0].max()
    assert north[0, 1] == north[:, 1].min()


def test_what_lies_left_of_the_ego_is_drawn_above_it(rollout):
    scene, played = rollout
    (view,) = views(rollout_strip(played, scene.road_map, [10]))

    ego, other = (
        corners(p.get("d")) for p in view.iter(f"{SVG}path") if "agent" in p.get("class")
    )

    assert other[:, 1].mean() < ego[:, 1].mean()


def test_titles_say_when_and_how_many(rollout):
    scene, played = rollout
    root = ET.fromstring(rollout_strip(played, scene.road_map, [10, 40]))

    words = [text.text for text in root.iter(f"{SVG}text")]
    assert words[:2] == ["t = 0 s, 2 agents", "t = 3 s, 3 agents"]


def test_roads_are_drawn_by_kind(drive):
    (view,) = views(scene_strip(drive(speed_mps=5.0), [10]))

    found = {path.get("class") for path in view.iter(f"{SVG}path")}
    assert {"lane", "edge", "zebra"} <= found


def test_names_are_escaped(drive):
    scene = replace(drive(speed_mps=5.0), scenario_id="<script>")

    assert "<script>" not in scene_strip(scene, [10])
