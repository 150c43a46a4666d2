from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.proper.context import CONTEXT, read_context
from infgen.metrics.traffic import observe_log
from infgen.scene import LinkType, SignalState


def numbers(scene, radius_m=75.0):
    found = read_context(scene, observe_log(scene), radius_m)
    return dict(zip([name for name, _ in CONTEXT], found.tolist(), strict=True))


def test_density_and_ego_are_those_of_now(crossing):
    # Of four agents the pedestrian comes after now; the car goes 10, the cyclist 4 m/s.
    found = numbers(crossing())

    assert found["vehicles"] == found["cyclists"] == 1
    assert found["pedestrians"] == 0
    assert found["mean_speed_mps"] == pytest.approx(7.0, abs=1e-3)
    assert found["standing_share"] == 0
    assert found["ego_speed_mps"] == pytest.approx(10.0, abs=1e-3)
    assert found["ego_lane_distance_m"] == pytest.approx(0.0, abs=1e-5)


def test_parked_cars_stand_and_numbers_are_square_roots(parked):
    found = numbers(parked(count=4))

    assert found["vehicles"] == 2
    assert found["standing_share"] == 1


def test_the_map_is_what_lies_around(parked, build_signals):
    # 200 m of lane, of which 2 x 75 m are near, and a crosswalk.
    scene = parked(signals=build_signals([(0, 1, SignalState.STOP)]))

    found = numbers(scene)

    assert found["lane_km"] == pytest.approx(0.149, abs=2e-3)
    assert found["crosswalks"] == found["signalled_lanes"] == 1
    assert found["branching_lanes"] == 0
    assert numbers(scene, radius_m=10.0)["crosswalks"] == 0


def test_a_lane_with_two_ways_on_branches(parked):
    scene = parked()
    links = replace(
        scene.road_map,
        link_lane_id=np.array([1, 1], np.int64),
        link_type=np.full(2, LinkType.EXIT, np.int8),
        link_other_id=np.array([8, 9], np.int64),
    )

    assert numbers(replace(scene, road_map=links))["branching_lanes"] == 1


def test_the_future_is_no_part_of_the_situation(crossing):
    early, late = crossing(), crossing(steps=40)

    assert numbers(early) == numbers(late)
