"""Where streets run: connected, without dead ends inside, as wide as asked."""

import numpy as np
import pytest

from infgen.sources.towns.streets.topology import WAY_OUT_M, draw_skeleton
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
