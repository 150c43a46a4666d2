import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from infgen.views.scene.style import DARK, LIGHT
from infgen.views.scene.view_model import make_view_model
from infgen.views.video.strips import (
    PICTURE_PX,
    make_strip,
    strip_picture,
    strip_svg,
    strip_times,
)
from tests.exports.replays import replay

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def short(crossing):
    """A log of nine seconds and a rollout of which two more are known."""
    scene = crossing(steps=111)
    early = replace(
        scene,
        timestamps_s=scene.timestamps_s[:91],
        tracks=replace(
            scene.tracks,
            **{
                name: getattr(scene.tracks, name)[:, :91]
                for name in ("xyz_m", "heading_rad", "velocity_mps", "size_lwh_m", "valid")
            },
        ),
    )
    return make_view_model(early, (replay(scene),))


def drawn(view_model, times, theme=LIGHT):
    return ET.fromstring(strip_svg(make_strip(view_model, times, theme), theme))


def test_moments_are_six_seconds_apart_as_far_as_the_longest_showing_goes(short):
    assert strip_times(short) == [0.0, 6.0]
    assert strip_times(short, 5.0) == [0.0, 5.0, 10.0]


def test_every_showing_has_a_row_and_every_moment_a_column(short):
    root = drawn(short, [0.0, 4.0, 8.0])

    places = [(p.get("x"), p.get("y")) for p in root.findall(f"{SVG}svg")]
    assert len(places) == 6
    assert len({x for x, _ in places}) == 3
    assert len({y for _, y in places}) == 2
    words = [text.text for text in root.iter(f"{SVG}text")]
    assert words[:3] == ["t = 0 s", "t = 4 s", "t = 8 s"]
    assert {"log", "rollout 0", "ego", "there at the start", "came in later"} <= set(words)


def test_where_the_log_is_over_it_says_so(short):
    root = drawn(short, [0.0, 10.0])

    assert [t.text for t in root.iter(f"{SVG}text")].count("the log has ended") == 1
    empty = [p for p in root.findall(f"{SVG}svg") if p.find(f"{SVG}path") is None]
    assert len(empty) == 1


def test_the_ego_is_in_the_middle_of_every_picture(short):
    for picture in drawn(short, [0.0, 4.0]).findall(f"{SVG}svg"):
        (ego,) = [
            path
            for path in picture.iter(f"{SVG}path")
            if path.get("fill") == LIGHT.ego and path.get("opacity") is None
        ]
        points = ego.get("d").strip("MZ").replace("L", " ").split()
        xy = np.array(points, float).reshape(-1, 2)
        middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
        np.testing.assert_allclose(middle, [PICTURE_PX / 2] * 2, atol=0.2)


def test_a_moment_that_is_not_shown_is_refused(short):
    with pytest.raises(ValueError, match=r"10\.1 s is not shown; the film ends at 10 s"):
        make_strip(short, [10.1], LIGHT)
    with pytest.raises(ValueError, match="-2 s is not shown"):
        make_strip(short, [-2.0], LIGHT)


def test_names_are_escaped(short):
    view_model = replace(short, scenario_id="<b>&")

    assert drawn(view_model, [0.0]).find(f"{SVG}title").text == "Scene <b>&"


def test_a_strip_is_painted_as_it_is_drawn(short):
    pytest.importorskip("aggdraw", reason="the extra video is not installed")
    strip = make_strip(short, [0.0, 4.0], DARK, scale=2.0)

    pixels = strip_picture(strip, DARK)

    assert pixels.shape == (round(strip.height_px), round(strip.width_px), 3)
    first = strip.pictures[0]
    x, y = (round(v + PICTURE_PX) for v in (first.x_px, first.y_px))
    middle = pixels[y - 6 : y + 6, x - 12 : x + 12].reshape(-1, 3)
    ego = np.array([int(DARK.ego[at : at + 2], 16) for at in (1, 3, 5)])
    assert (np.abs(middle.astype(int) - ego).max(axis=1) < 4).mean() > 0.3
