import xml.etree.ElementTree as ET

import pytest

from infgen.views.charts.axes import drawing
from infgen.views.page import STYLE, page, sheet

SVG = "{http://www.w3.org/2000/svg}"


def test_a_sheet_sets_drawings_in_rows_that_do_not_overlap():
    wide, small = drawing(300.0, 200.0, "wide", []), drawing(100.0, 50.0, "small", [])

    root = ET.fromstring(sheet("<both>", [wide, small, small], columns=2))

    places = [group.get("transform") for group in root.findall(f"{SVG}g")]
    assert places == ["translate(0 34)", "translate(316 34)", "translate(0 250)"]
    assert root.get("viewBox") == "0 0 416 316"
    assert root.find(f"{SVG}title").text == "<both>"


def test_a_sheet_stands_alone_with_its_own_colours_and_paper():
    root = ET.fromstring(sheet("t", [drawing(10.0, 10.0, "a", [])]))

    style = root.find(f"{SVG}style").text
    assert "--c0" in style
    assert "prefers-color-scheme: dark" in style
    assert "max-width" not in style  # Would shrink the drawings in it.
    assert root.find(f"{SVG}rect").get("class") == "paper"


def test_every_class_of_colour_that_drawings_use_is_in_the_style():
    for look in (".c5", ".d5", ".w5", ".band", ".diagonal", ".inked", ".small"):
        assert look in STYLE
    assert STYLE in page("t", [])


def test_a_drawing_without_a_size_cannot_be_set():
    with pytest.raises(ValueError, match="viewBox"):
        sheet("t", ["<svg/>"])
