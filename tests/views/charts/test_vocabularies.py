import re
from xml.etree import ElementTree

import numpy as np
import pytest

from infgen.config import VocabSettings
from infgen.tokens.clustering.coverage import Matches, describe_map, describe_motion
from infgen.tokens.clustering.vocabularies import Origin
from infgen.views.charts.vocabularies import vocabulary_page

NOTHING = Matches(np.empty(0, np.int8), np.empty(0, int), np.empty(0))


@pytest.fixture
def page(metre_moves, bent_roads):
    move_origin = np.full((3, 61), Origin.LOGGED, np.int8)
    move_origin[2] = Origin.MADE
    road_origin = np.full(9, Origin.LOGGED, np.int8)
    curves = bent_roads.curve_m
    report = {
        "scenes": {"learn": 7, "held-out": 0},
        "validation_split": "0 scenes of split <none>",
        "tolerance_m": 0.05,
        "road_tolerance_m": 0.1,
        "motion": describe_motion(
            metre_moves, move_origin, NOTHING, NOTHING, VocabSettings()
        ),
        "roads": describe_map(bent_roads, road_origin, curves, curves),
    }
    return vocabulary_page(report, metre_moves, move_origin, bent_roads, road_origin)


def pictures(page):
    return [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page)]


def test_the_page_is_self_contained(page):
    assert page.startswith("<!doctype html>")
    assert not re.search(r"<script|<link|<img|@import|url\(", page)
    links = re.findall(r"https?://[^\"]*", page)
    assert set(links) == {"http://www.w3.org/2000/svg"}


def test_every_kind_and_the_map_have_a_picture_that_is_valid_svg(page):
    assert len(pictures(page)) == 4


def test_every_move_is_drawn_in_the_colour_of_its_origin(page):
    for svg, count in zip(pictures(page), [61, 61, 61, 9], strict=True):
        drawn = [path for path in svg.iter() if path.get("stroke-opacity")]
        assert len(drawn) == 1
        assert len(re.findall("M", drawn[0].get("d"))) == count
    vehicle, _, cyclist, _ = pictures(page)
    colours = [
        {path.get("stroke") for path in svg.iter() if path.get("stroke-opacity")}
        for svg in (vehicle, cyclist)
    ]
    assert colours[0] != colours[1]


def test_what_could_not_be_measured_is_said_and_words_are_escaped(page):
    assert "nothing to measure" in page
    assert "split &lt;none&gt;" in page
    assert "7 scenes" in page


def test_nothing_is_drawn_outside_the_picture(page):
    for svg in pictures(page):
        _, _, width, height = map(float, svg.get("viewBox").split())
        for path in svg.iter():
            if path.get("stroke-opacity"):
                lines = path.get("d").replace("m-.8 0h1.6", "")  # the dots at the ends
                points = re.findall(r"[ML ]?(-?[\d.]+) (-?[\d.]+)", lines)
                xy = np.array(points, float)
                assert (xy >= -0.1).all()
                assert (xy <= [width + 0.1, height + 0.1]).all()
