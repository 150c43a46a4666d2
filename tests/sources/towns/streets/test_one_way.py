"""One-way streets, on a square of four streets with one across it."""

import numpy as np
import pytest

from infgen.sources.towns.streets.one_way import draw_one_way, goes_on_everywhere
from infgen.sources.towns.streets.topology import Skeleton

SQUARE = Skeleton(
    xy_m=np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]]),
    link=np.array([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]),
)


@pytest.mark.parametrize(
    ("one_way", "goes_on"),
    [
        ([0, 0, 0, 0, 0], True),
        ([1, 0, -1, 1, 1], True),  # Round the square, and both ways across it.
        ([1, 0, 1, 0, 0], False),  # Who comes to node 0 across the square is stuck.
        ([1, 1, 1, 0, 0], False),  # No way back to node 0.
        ([1, 0, 0, -1, 0], False),  # Both lead into node 1, and none out of it.
    ],
)
def test_one_way_streets_leave_a_way_on_everywhere(one_way, goes_on):
    assert goes_on_everywhere(SQUARE, np.array(one_way)) == goes_on


def test_arterials_and_ways_out_of_town_have_both_directions():
    minor = np.array([True, False, True, True, True])
    out = Skeleton(
        np.append(SQUARE.xy_m, [[-200.0, 0.0]], axis=0),
        np.append(SQUARE.link, [[0, 4]], axis=0),
    )
    for seed in range(20):
        rng = np.random.default_rng(seed)
        one_way = draw_one_way(out, np.arange(6), np.append(minor, True), 1.0, rng)
        assert one_way[1] == one_way[5] == 0
        assert goes_on_everywhere(out, one_way)


@pytest.mark.parametrize(("most", "drawn"), [(0.0, False), (1.0, True)])
def test_no_street_is_one_way_where_none_is_asked_for(most, drawn):
    rng = np.random.default_rng(0)
    found = [
        draw_one_way(SQUARE, np.arange(5), np.ones(5, bool), most, rng) for _ in range(50)
    ]
    assert np.any(found) == drawn
