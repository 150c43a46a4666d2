"""Where the map ends: a car that drives along +x, past the end of its lane."""

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.metrics.flow import count_flow
from infgen.metrics.traffic import OFF_MAP_M, from_log, on_map
from infgen.rollout.rules.off_road import lane_segments
from tests.conftest import straight_road

LANE_M = 40.0
"""The lane goes on for so far after the origin, where the car is at the first step."""


@pytest.fixture
def traffic(drive):
    """``traffic(speed_mps)``: a log of 9.1 s on a short road, and the road's lanes."""

    def build(speed_mps):
        scene = drive(speed_mps, road_map=straight_road(2 * LANE_M))
        return from_log(scene, TokenSettings()), lane_segments(scene)

    return build


@pytest.mark.parametrize("speed_mps", [8.0, 10.0, 20.0])
def test_a_log_is_cut_where_the_ego_is_too_far_from_every_lane(traffic, speed_mps):
    whole, lanes = traffic(speed_mps)

    cut = on_map(whole, lanes)

    end = cut.motion.x_m.shape[2]
    left = np.flatnonzero(whole.motion.x_m[0, 0] > LANE_M + OFF_MAP_M)
    if not len(left):
        assert cut is whole
    else:
        assert left[0] <= end < left[0] + 5  # It is looked at every token step.
        assert cut.motion.valid.shape == (1, 1, end)


def test_who_stays_on_the_map_and_who_has_none_are_left_alone(traffic):
    whole, lanes = traffic(3.0)
    away, _ = traffic(20.0)
    nothing = (lanes[0][:0], lanes[1][:0])

    assert on_map(whole, lanes) is whole
    assert on_map(away, nothing) is away


def test_less_of_what_is_cut_is_counted(traffic):
    whole, lanes = traffic(20.0)

    before, after = (count_flow(one, 75.0) for one in (whole, on_map(whole, lanes)))

    assert 0 < after.tokens < before.tokens
