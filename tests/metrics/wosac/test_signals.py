import numpy as np
import pytest

from infgen.metrics.wosac.signals import build_stop_lines, runs_red_light
from infgen.scene import SignalState
from tests.metrics.moving import boxes

STEPS = 11
FIRST = np.array([0])
# The lane runs east along y = 0, its signal's stop point at x = 10. Longer than the other
# lane by far, so no padding starts from it.
LANE = np.array([(x, 0.0, 0.0) for x in range(0, 41, 2)], dtype=np.float32)
OTHER = np.array([(x, 30.0, 0.0) for x in range(0, 41, 4)], dtype=np.float32)
DRIVER = (4, 0, 0.0, 15.0)  # passes x = 10 between steps 4 (10.0) and 5 (11.5)


def lines(state=SignalState.STOP, signal_lane=7, lanes=(LANE, OTHER)):
    states = np.full((1, STEPS), state, dtype=np.int8)
    stops = np.zeros((1, STEPS, 2), dtype=np.float32)
    stops[:] = (10.0, 0.0)
    ids = np.array([7, 8][: len(lanes)], dtype=np.int64)
    return build_stop_lines(ids, lanes, np.array([signal_lane]), states, stops)


def crossing(*paths, **more):
    motion = boxes(*paths, valid=more.pop("valid", None))
    return runs_red_light(motion, FIRST, lines(**more))[0, 0]


@pytest.mark.parametrize("state", [SignalState.STOP, SignalState.ARROW_STOP])
def test_crossing_the_stop_line_under_red_is_a_violation_at_that_step(state):
    found = crossing((4.2, 0, 0, 15), state=state)

    np.testing.assert_array_equal(np.flatnonzero(found), [4])


@pytest.mark.parametrize(
    "state",
    [
        SignalState.UNKNOWN,
        SignalState.GO,
        SignalState.CAUTION,
        SignalState.ARROW_CAUTION,
        SignalState.FLASHING_STOP,
        SignalState.FLASHING_CAUTION,
    ],
)
def test_other_states_may_be_crossed(state):
    assert not crossing((4.2, 0, 0, 15), state=state).any()


def test_who_stops_before_the_line_is_no_violator():
    assert not crossing((4, 0, 0, 5)).any()


def test_who_starts_beyond_the_line_is_no_violator():
    assert not crossing((12, 0, 0, 15)).any()


def test_backing_over_the_line_is_no_violation():
    assert not crossing((14, 0, 0, -15)).any()


def test_who_crosses_beside_another_lane_is_no_violator():
    assert not crossing((4.2, 29.0, 0, 15)).any()


def test_a_signal_of_a_lane_that_is_not_in_the_map_speaks_to_nobody():
    assert not crossing((4.2, 0, 0, 15), signal_lane=99).any()


def test_who_is_not_there_at_the_crossing_is_no_violator():
    valid = np.ones((1, STEPS), bool)
    valid[0, 4] = False

    assert not crossing((4.2, 0, 0, 15), valid=valid).any()


def test_without_lanes_nobody_violates():
    none = build_stop_lines(
        np.zeros(0, np.int64),
        [],
        np.array([7]),
        np.full((1, STEPS), SignalState.STOP, np.int8),
        np.zeros((1, STEPS, 2), np.float32),
    )

    assert not runs_red_light(boxes(DRIVER), FIRST, none).any()


def test_without_signals_nobody_violates():
    none = build_stop_lines(
        np.array([7]),
        [LANE],
        np.zeros(0, np.int64),
        np.zeros((0, STEPS), np.int8),
        np.zeros((0, STEPS, 2), np.float32),
    )

    assert not runs_red_light(boxes(DRIVER), FIRST, none).any()


def test_the_line_from_a_shorter_lane_to_the_worlds_zero_catches_as_officially():
    # A second lane ends half a metre ahead of where our driver crosses. From there the
    # padding's segment runs to (0, 0); measured to the mirror image it is nearer than the
    # driver's own lane, and the violation is lost.
    short = np.array([(100, 1.5, 0), (10.5, 1.5, 0)], dtype=np.float32)
    far = np.array([(x, 4.0, 0.0) for x in range(0, 41, 2)], dtype=np.float32)
    stops = np.zeros((1, STEPS, 2), dtype=np.float32)
    stops[:] = (10.0, 4.0)
    states = np.full((1, STEPS), SignalState.STOP, dtype=np.int8)
    both = build_stop_lines(np.array([7, 8]), [far, short], np.array([7]), states, stops)
    alone = build_stop_lines(np.array([7]), [far], np.array([7]), states, stops)
    driver = boxes((4.2, 1.5, 0, 15))

    assert runs_red_light(driver, FIRST, alone).any()
    assert not runs_red_light(driver, FIRST, both).any()


def test_each_rollout_is_judged_by_itself():
    motion = boxes((4.2, 0, 0, 15))
    both = type(motion)(
        x_m=np.concatenate([motion.x_m, motion.x_m - 50]),
        y_m=np.repeat(motion.y_m, 2, axis=0),
        z_m=np.repeat(motion.z_m, 2, axis=0),
        heading_rad=np.repeat(motion.heading_rad, 2, axis=0),
        size_lwh_m=motion.size_lwh_m,
        agent_type=motion.agent_type,
        valid=np.repeat(motion.valid, 2, axis=0),
    )

    np.testing.assert_array_equal(
        runs_red_light(both, FIRST, lines()).any(axis=(1, 2)), [True, False]
    )
