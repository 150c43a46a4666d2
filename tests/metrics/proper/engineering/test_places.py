from dataclasses import replace

import numpy as np
import pytest

from infgen.metrics.proper.engineering.green import delays_s, find_greens
from infgen.metrics.proper.engineering.lanes import lane_traffic, read_lanes
from infgen.metrics.proper.engineering.turns import find_junctions, turns_deg
from infgen.scene import FeatureType, LaneType, LinkType, SignalState
from tests.metrics.proper.roads import NOW, at_speeds, path, vehicles

LANE_ID = 1
Y_M = 20.0


@pytest.fixture
def road(build_map):
    """A lane of 100 m along +x, 20 m beside the ego, and one of 20 m beyond it."""
    x_m = np.linspace(-50, 50, 21)
    return build_map(
        [
            (
                1,
                FeatureType.LANE,
                LaneType.SURFACE_STREET,
                np.column_stack([x_m, 0 * x_m + Y_M]),
            ),
            (
                2,
                FeatureType.LANE,
                LaneType.SURFACE_STREET,
                np.array([[50, Y_M], [70, Y_M]]),
            ),
        ]
    )


def links(road_map, *exits):
    """The map with pairs (lane, lane that goes on from it)."""
    lane, other = np.array(exits, np.int64).reshape(-1, 2).T
    return replace(
        road_map,
        link_lane_id=lane,
        link_type=np.full(len(lane), LinkType.EXIT, np.int8),
        link_other_id=other,
    )


def test_junctions_are_where_lanes_branch(road):
    assert len(find_junctions(links(road, (1, 2)))) == 0
    found = find_junctions(links(road, (1, 2), (1, 3)))
    np.testing.assert_allclose(found, [[50.0, Y_M]])
    both = find_junctions(links(road, (1, 2), (1, 3), (2, 4), (2, 5)))
    np.testing.assert_allclose(both, [[60.0, Y_M]])  # 20 m apart: one junction.


def bend(turn_rad):
    """Drives to the origin for 3 s at 10 m/s, turns there at once and goes on."""
    before = path(at_speeds(-30.0, (10.0, 30)), Y_M)
    out_m = at_speeds(0.0, (10.0, 31))[1:]
    after = path(out_m * np.cos(turn_rad), Y_M + out_m * np.sin(turn_rad), turn_rad)
    return np.concatenate([before, after])


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, -90.0, 45.0])
def test_a_turn_is_that_between_entering_and_leaving_a_junction(turn_deg):
    found = vehicles(bend(np.radians(turn_deg)), steps=62)

    turns = turns_deg(found, np.array([[0.0, Y_M]]))
    np.testing.assert_allclose(turns, [turn_deg], atol=1e-3)


def test_who_begins_in_a_junction_or_passes_by_does_not_turn_there():
    inside = vehicles((0.0, Y_M, 0.0, 10.0))
    beside = vehicles((-50.0, Y_M + 15.0, 0.0, 15.0))

    assert len(turns_deg(inside, np.array([[0.0, Y_M]]))) == 0
    assert len(turns_deg(beside, np.array([[0.0, Y_M]]))) == 0


def test_density_flow_and_speed_of_a_lane(road):
    # One vehicle in 100 m at 10 m/s: 10 per km, 360 per hour. The short lane is left out.
    lanes = read_lanes(road, np.zeros(2), 75.0)

    found = lane_traffic(vehicles((-40.0, Y_M, 0.0, 10.0)), lanes)

    np.testing.assert_allclose(found.density_per_km, [10.0])
    np.testing.assert_allclose(found.flow_per_h, [360.0], rtol=1e-4)
    np.testing.assert_allclose(found.speed_mps, [10.0], rtol=1e-4)


@pytest.mark.parametrize(
    "car",
    [
        (-40.0, Y_M + 3.0, 0.0, 10.0),  # Beside it.
        (40.0, Y_M, np.pi, 10.0),  # The wrong way.
    ],
)
def test_a_lane_that_nobody_drives_in_has_no_density_and_no_speed(road, car):
    found = lane_traffic(vehicles(car), read_lanes(road, np.zeros(2), 75.0))

    np.testing.assert_array_equal(found.density_per_km, [0.0])
    np.testing.assert_array_equal(found.flow_per_h, [0.0])
    assert len(found.speed_mps) == 0


def test_lanes_that_reach_beyond_the_radius_are_not_measured(road):
    found = lane_traffic(vehicles(), read_lanes(road, np.array([0.0, 0.0]), 45.0))

    assert len(found.density_per_km) == 0


def lights(build_signals, *states):
    """Lights of the lane from step 0 on, stop line at 30 m: (state, steps) in turn."""
    shown = [state for state, steps in states for _ in range(steps)]
    signals = build_signals([(step, LANE_ID, state) for step, state in enumerate(shown)])
    stop_m = np.tile(np.array([30.0, Y_M, 0.0], np.float32), (len(shown), 1))
    return replace(signals, stop_xyz_m=stop_m)


@pytest.fixture
def greens(road, build_signals):
    """Red until step 20, green from step 21."""
    shown = lights(build_signals, (SignalState.STOP, 21), (SignalState.GO, 40))
    return find_greens(shown, road, NOW)


def test_a_green_is_where_red_ends_after_now(greens, road, build_signals):
    assert greens.step.tolist() == [21 - NOW - 1]
    np.testing.assert_allclose(greens.stop_m, [[30.0, Y_M]])
    np.testing.assert_allclose(greens.way_rad, [0.0])
    never = lights(build_signals, (SignalState.CAUTION, 20), (SignalState.GO, 20))
    assert len(find_greens(never, road, NOW).step) == 0
    before = lights(build_signals, (SignalState.STOP, 1), (SignalState.GO, 20))
    assert len(find_greens(before, road, NOW).step) == 0


def test_the_first_in_the_queue_sets_off_some_time_after_green(greens):
    # The first moves after step 30: it is faster than 0.5 m/s at step 30, 0.9 s after 21.
    first = path(at_speeds(24.0, (0.0, 30), (5.0, 30)), Y_M)
    second = path(at_speeds(20.0, (0.0, 50), (5.0, 10)), Y_M)

    np.testing.assert_allclose(delays_s(vehicles(second, first), greens), [0.9])


@pytest.mark.parametrize(
    "car",
    [
        path(at_speeds(24.0, (0.0, 60)), Y_M),  # Does not set off.
        path(at_speeds(-20.0, (10.0, 60)), Y_M),  # Does not stand.
        path(at_speeds(10.0, (0.0, 30), (5.0, 30)), Y_M),  # Not at the line.
        path(at_speeds(24.0, (0.0, 30), (5.0, 30)), Y_M + 4),  # In the next lane.
    ],
)
def test_without_a_queue_that_sets_off_there_is_no_delay(greens, car):
    assert len(delays_s(vehicles(car), greens)) == 0
