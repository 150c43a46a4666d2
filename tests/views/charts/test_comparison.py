import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from infgen.views.charts.comparison import comparison_chart
from infgen.views.charts.figures import Series

SVG = "{http://www.w3.org/2000/svg}"


def line(name, y):
    return Series(name, np.arange(len(y), dtype=float), np.array(y, float))


def drawn(lines, truth=None):
    svg = comparison_chart(lines, truth, title="t", x_label="x", y_label="y")
    return ET.fromstring(svg)


def looks(root):
    """Classes of the lines in their order; each stands in the legend too."""
    found = [path.get("class") for path in root.iter(f"{SVG}path")]
    return [look for look in found if "line" in look.split()][::2]


@pytest.mark.parametrize("count", [1, 7, 12, 36])
def test_no_two_methods_look_alike_however_many_there_are(count):
    found = looks(drawn([line(f"m{at}", [0.0, at]) for at in range(count)]))

    assert len(found) == len(set(found)) == count


def test_the_truth_is_drawn_in_ink_and_named_last():
    root = drawn([line("one", [0.0, 1.0])], line("the logs", [1.0, 1.0]))

    assert looks(root) == ["line c0 d0", "line inked"]
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert texts.index("one") < texts.index("the logs")


def test_every_name_lies_within_the_chart():
    root = drawn(
        [line(f"method {at}", [0.0, at]) for at in range(9)], line("t", [1.0, 2.0])
    )

    width, height = map(float, root.get("viewBox").split()[2:])
    for text in root.iter(f"{SVG}text"):
        if text.get("x"):
            assert 0 <= float(text.get("x")) < width
            assert 0 <= float(text.get("y")) < height


def test_a_method_without_any_value_is_named_all_the_same():
    root = drawn([line("none", [np.nan, np.nan]), line("some", [1.0, 2.0])])

    assert not re.search("nan", ET.tostring(root, encoding="unicode"))
    assert {"none", "some"} <= {text.text for text in root.iter(f"{SVG}text")}
