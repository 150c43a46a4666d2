"""How full a street is to be, by hand: a lane along +x from -100 to 100 m."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.rollout.rules.density import DensityControl, segments_of
from infgen.scene import FeatureType
from tests.conftest import LANE_ID
from tests.rollout.rules.test_collision import everyone
from tests.rollout.rules.test_off_road import scene_of, street


def wanted(ego_x_m, scene):
    """Of 10 others at now, at the origin, where 149 pieces of a metre begin within 75 m."""
    density = DensityControl(
        at_now=np.array([10]),
        lanes_m=np.array([149.0 if scene is not EMPTY else 0.0]),
        segments=[segments_of(scene)],
        scene=np.zeros(1, dtype=np.int64),
        radius_m=75.0,
    )
    return density.wanted(np.array([[ego_x_m, 0.0]], dtype=np.float32)).item()


EMPTY = scene_of([])
METRES = np.arange(0.0, 11.0)


@pytest.mark.parametrize(
    ("ego_x_m", "expected"),
    [
        (0.0, 10.0),
        (60.0, 10.0),  # 115 m are ahead of it and behind: more than half.
        (137.5, 10 * 37 / 74.5),  # 37 pieces begin beyond 62.5 m.
        (300.0, 0.0),
    ],
)
def test_where_a_map_ends_there_are_to_be_fewer(ego_x_m, expected):
    assert wanted(ego_x_m, street()) == pytest.approx(expected)


def test_every_rollout_is_on_its_own_map(start):
    """The lanes of the second are 10 m long, and there are three others around its ego."""
    lane = np.column_stack([METRES, 0 * METRES])
    short = scene_of([(LANE_ID, FeatureType.LANE, 0, lane)])
    short = replace(short, scenario_id="short")
    now = everyone((0, 0, 0), (10, 0, 0), (12, 0, 0), (14, 0, 0)).take(np.array([0, 0]))

    density = DensityControl.of([start(street()), start(short)], now, 75.0)

    assert density.lanes_m == pytest.approx([149.0, 10.0])
    there = np.array([[137.5, 0.0], [77.5, 0.0]], dtype=np.float32)
    assert density.wanted(there) == pytest.approx([3 * 37 / 74.5, 3.0])


def test_a_map_without_lanes_is_everywhere_as_it_was():
    assert wanted(300.0, EMPTY) == 10.0


def test_what_is_around_at_now_is_looked_at(start):
    scene = street()
    now = everyone((0, 0, 0), (10, 0, 0), (0, 74, 0), (76, 0, 0))

    density = DensityControl.of([start(scene)], now, 75.0)

    assert density.at_now.tolist() == [2]
    assert density.lanes_m == pytest.approx([149.0])
    assert density.wanted(np.zeros((1, 2), dtype=np.float32)).tolist() == [2.0]
