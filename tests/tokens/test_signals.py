import numpy as np
import pytest

from infgen.scene import SignalState
from infgen.tokens.scene_tokens import SignalClass
from infgen.tokens.signals import (
    REMEMBERED,
    classify_signals,
    hold_last_signals,
    signal_polylines,
    signals_at,
)


@pytest.mark.parametrize("state", SignalState)
def test_states_are_merged_by_what_their_name_says(state):
    said = next((c for c in SignalClass if state.name.endswith(c.name)), None)

    assert classify_signals(np.int8([state])) == [said]


def test_a_state_that_nobody_has_heard_of_is_unknown():
    assert (classify_signals(np.int8([-1, 9, 100])) == SignalClass.UNKNOWN).all()


def test_a_light_is_read_at_the_steps_asked_for(build_signals):
    signals = build_signals(
        [
            (4, 7, SignalState.GO),
            (5, 7, SignalState.STOP),
            (5, 8, SignalState.ARROW_GO),
            (10, 7, SignalState.UNKNOWN),
        ]
    )

    shown = signals_at(signals, np.array([8, 7, 9]), np.array([5, 10]))

    none = SignalClass.NO_SIGNAL
    expected = [
        [SignalClass.GO, none],
        [SignalClass.STOP, SignalClass.UNKNOWN],
        [none, none],
    ]
    np.testing.assert_array_equal(shown, expected)


def test_of_two_states_at_one_step_the_later_row_counts(build_signals):
    signals = build_signals([(5, 7, SignalState.GO), (5, 7, SignalState.STOP)])

    assert signals_at(signals, np.array([7]), np.array([5])) == [[SignalClass.STOP]]


def test_without_lights_or_lanes_nothing_is_shown(build_signals):
    lit = build_signals([(5, 7, SignalState.GO)])

    assert signals_at(build_signals(), np.array([7]), np.array([5])) == [
        [SignalClass.NO_SIGNAL]
    ]
    assert signals_at(lit, np.empty(0, np.int64), np.array([5])).shape == (0, 1)


def test_lines_with_a_light_are_listed_once_and_only_until_a_step(build_signals):
    signals = build_signals([(3, 70, SignalState.GO), (30, 80, SignalState.GO)])
    line = np.int32([0, 0, 1, 2, 2])
    feature_id = np.array([70, 70, 90, 80, 80])

    lines, lanes = signal_polylines(signals, line, feature_id, last_step=90)
    early, _ = signal_polylines(signals, line, feature_id, last_step=10)

    assert lines.tolist() == [0, 2]
    assert lanes.tolist() == [70, 80]
    assert early.tolist() == [0]


def test_a_light_that_is_looked_at_no_more_is_remembered_as_it_was_last():
    shown = np.array([[0, 1, 2, 3], [4, 0, 0, 1]], np.int8)

    assert hold_last_signals(shown, 2, 5).tolist() == [[0, 1, 6, 6, 6], [4, 0, 5, 5, 5]]
    np.testing.assert_array_equal(hold_last_signals(shown, 4, 4), shown)
    assert hold_last_signals(shown, 2, 5).dtype == np.int8
    assert len(SignalClass) == REMEMBERED
