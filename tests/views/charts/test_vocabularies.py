import numpy as np
import pytest
from matplotlib.colors import to_hex

from infgen.tokens.clustering.vocabularies import Origin
from infgen.views.charts.canvas import COLOURS
from infgen.views.charts.vocabularies import vocabulary_charts


@pytest.fixture
def charts(metre_moves, bent_roads):
    motion_origin = np.full((3, 61), Origin.LOGGED, np.int8)
    motion_origin[2] = Origin.MADE
    road_origin = np.full(9, Origin.LOGGED, np.int8)
    motion, roads = vocabulary_charts(metre_moves, motion_origin, bent_roads, road_origin)
    return [*motion, roads]


def lines(chart):
    """The one line of all curves and their ends."""
    (axes,) = chart.figure.axes
    return axes.get_lines()


def test_every_agent_type_and_the_map_have_a_chart(charts):
    assert [chart.title.split(":")[0] for chart in charts] == [
        "Vehicle",
        "Pedestrian",
        "Cyclist",
        "Map tokens",
    ]


def test_every_token_is_drawn_in_the_colour_of_its_origin(charts):
    for chart, count in zip(charts, [61, 61, 61, 9], strict=True):
        (line,) = lines(chart)
        gaps = np.isnan(line.get_xdata()).sum()
        assert gaps == 2 * count  # One behind the curve, one behind its end.
    assert to_hex(lines(charts[0])[0].get_color()) == COLOURS[0]
    assert to_hex(lines(charts[2])[0].get_color()) == COLOURS[1]


def test_curves_are_drawn_to_scale_and_within_the_axes(charts):
    for chart in charts:
        (axes,) = chart.figure.axes
        xy = axes.get_lines()[0].get_xydata()
        ends = np.array([axes.get_xlim(), axes.get_ylim()]).T
        known = xy[np.isfinite(xy).all(1)]
        assert (known >= ends[0] - 0.1).all()
        assert (known <= ends[1] + 0.1).all()
        box = axes.get_window_extent()
        width_m, height_m = ends[1] - ends[0]
        assert box.width / width_m == pytest.approx(box.height / height_m, rel=1e-6)


def test_a_chart_of_thousands_of_tokens_stays_small(metre_moves, charts):
    assert len(charts[0].to_svg()) < 60_000
