import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from infgen.views.charts.canvas import (
    COLOURS,
    Chart,
    set_logarithmic,
    write_pdf,
    write_sheet,
)

SVG = "{http://www.w3.org/2000/svg}"


def chart(title="A <b> & c", draw=lambda axes: axes.plot([0, 1], [0, 1])):
    return Chart(title, draw, 300.0, 200.0, (60.0, 10.0, 30.0, 40.0))


def texts(svg):
    return [element.text for element in ET.fromstring(svg).iter(f"{SVG}text")]


def test_svg_is_well_formed_in_pixels_and_its_words_are_escaped():
    root = ET.fromstring(chart().to_svg())

    assert (root.get("width"), root.get("height")) == ("300", "200")
    assert root.get("viewBox") == "0 0 300 200"
    assert root.find(f"{SVG}title").text == "A <b> & c"
    assert "A <b> & c" in texts(chart().to_svg())


def test_the_same_chart_is_the_same_bytes():
    assert chart().to_svg() == chart().to_svg()
    assert write_pdf([chart(), chart()]) == write_pdf([chart(), chart()])


def test_every_colour_follows_the_page_and_is_there_without_one():
    svg = chart(draw=lambda axes: axes.plot([0, 1], color=COLOURS[2])).to_svg()

    assert f"stroke: var(--c2, {COLOURS[2]})" in svg
    without = re.sub(r"var\(--\w+, #[0-9a-f]{6}\)", "", svg)
    assert not re.search(r"#[0-9a-f]{6}\b(?!\")", without)


def test_every_colour_of_charts_has_a_value_in_the_style_of_pages():
    style = Path("infgen/views/templates/page.css").read_text()

    for variable in re.findall(r"var\(--(\w+)", chart().to_svg()):
        assert f"--{variable}:" in style
    for at, colour in enumerate(COLOURS):
        assert f"--c{at}: {colour}" in style


def test_a_pdf_has_a_page_of_its_own_size_for_each_chart_and_holds_its_fonts():
    pdf = write_pdf([chart(), chart()])

    assert pdf.startswith(b"%PDF")
    assert re.findall(rb"/MediaBox \[ 0 0 (\d+) (\d+) \]", pdf) == [(b"300", b"200")] * 2
    assert b"/FontFile2" in pdf


def test_numbers_in_words_keep_their_decimals_and_places_do_not():
    svg = chart("0.123456", lambda axes: axes.plot([0.111111, 0.777777])).to_svg()

    assert "0.123456" in texts(svg)
    assert not re.search(r"\.\d{3}", re.sub(">[^<]*<", "><", svg))


def test_a_dollar_sign_is_a_dollar_sign():
    assert "$5 and $6" in texts(chart("$5 and $6").to_svg())


def test_a_logarithmic_axis_has_plain_numbers():
    def draw(axes):
        set_logarithmic(axes)
        axes.plot([1, 2, 3], [0.03, 1.0, 40.0])

    assert {"0.05", "1", "20"} <= set(texts(chart(draw=draw).to_svg()))


def test_a_sheet_sets_charts_in_rows_that_do_not_overlap():
    root = ET.fromstring(write_sheet("<all>", [chart(f"chart {at}") for at in range(5)], 2))
    places = {
        text.text: (float(text.get("x")), float(text.get("y")))
        for text in root.iter(f"{SVG}text")
        if text.text.startswith("chart")
    }

    assert root.find(f"{SVG}title").text == "<all>"
    assert places["chart 1"][0] - places["chart 0"][0] == pytest.approx(316, abs=0.1)
    assert places["chart 2"][1] - places["chart 0"][1] == pytest.approx(216, abs=0.1)
    assert np.allclose(places["chart 0"][0], places["chart 4"][0], atol=0.1)


def test_a_sheet_of_nothing_is_still_a_drawing():
    assert texts(write_sheet("none", [])) == ["none"]
