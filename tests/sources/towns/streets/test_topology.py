"""Where streets run: connected, without dead ends inside, as wide as asked."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.sources.towns.streets.topology import WAY_OUT_M, draw_skeleton
from infgen.sources.towns.variety import BROAD, Pattern
from tests.sources.towns.conftest import needs_sumo

pytestmark = needs_sumo


def draw(tmp_path, seed, spread):
    return draw_skeleton(tmp_path, np.random.default_rng(seed), spread)


def width_m(skeleton):
    """From side to side, the ways out left out."""
    inner_m = skeleton.xy_m[skeleton.degree > 1]
    return np.ptp(inner_m, axis=0).mean()


def test_only_ways_out_end(tmp_path):
    skeleton = draw(tmp_path, 0, 1.0)

    (ends,) = np.nonzero(skeleton.degree == 1)
    assert len(ends)
    for end in ends:
        (link,) = skeleton.link[(skeleton.link == end).any(axis=1)]
        way_m = np.diff(skeleton.xy_m[link], axis=0)
        assert np.linalg.norm(way_m) == pytest.approx(WAY_OUT_M)


@pytest.mark.parametrize("seed", range(6))  # All three patterns.
def test_a_town_is_as_many_times_wider_as_asked(tmp_path, seed):
    common, wide = (draw(tmp_path, seed, spread) for spread in (1.0, 2.5))

    assert 1.5 < width_m(wide) / width_m(common) < 3.5
    assert len(wide.link) > 3 * len(common.link)
    assert (wide.degree > 1).all()


def draw_pattern(tmp_path, seed, pattern):
    variety = replace(BROAD.streets, patterns={pattern: 1.0})
    return draw_skeleton(tmp_path, np.random.default_rng(seed), 2.0, variety)


@pytest.mark.parametrize("seed", range(3))
def test_streets_of_a_town_of_t_junctions_hardly_cross(tmp_path, seed):
    grid, junctions = (
        draw_pattern(tmp_path, seed, each) for each in (Pattern.GRID, Pattern.T_JUNCTIONS)
    )

    assert (grid.degree > 3).mean() > 0.5
    assert (junctions.degree > 3).mean() < 0.25
    assert (junctions.degree > 1).all()
    reached = {0}
    for _ in range(len(junctions.xy_m)):
        reached |= {
            node for pair in junctions.link.tolist() if reached & set(pair) for node in pair
        }
    assert len(reached) == len(junctions.xy_m)


@pytest.mark.parametrize("seed", range(3))
def test_streets_of_a_curved_grid_wind(tmp_path, seed):
    straight, curved = (
        _directions(draw_pattern(tmp_path, seed, each))
        for each in (Pattern.GRID, Pattern.CURVED_GRID)
    )

    assert curved.std() > 2 * straight.std()


def _directions(skeleton):
    """Directions of all links, modulo a right angle, around that of most."""
    way_m = skeleton.xy_m[skeleton.link[:, 1]] - skeleton.xy_m[skeleton.link[:, 0]]
    turned = 4 * np.arctan2(way_m[:, 1], way_m[:, 0])
    return np.angle(np.exp(1j * turned)) / 4
