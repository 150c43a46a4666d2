import numpy as np
import pytest

from infgen.clock import CLOCK
from infgen.exports.states import NO_LIGHT, lights_of, states_of
from infgen.scene import SignalState
from infgen.tokens.signals import REMEMBERED, classify_signals, hold_last_signals
from infgen.tokens.tokenizer import read_logged_signals
from tests.exports.replays import replay, with_newcomer


def test_states_are_in_the_world_frame_and_zero_where_nobody_is(crossing):
    scene = crossing()
    states = states_of(with_newcomer(replay(scene), 40), scene)

    assert states.id.tolist() == [100, 101, 103, 104]
    assert states.xyz_m[0, 0] == pytest.approx([960, -2000, 10.8])
    assert not states.xyz_m[3, :41].any()
    assert states.xyz_m[3, 41, 1] == pytest.approx(-1995)


def test_velocities_are_the_logs_and_then_differences(drive):
    scene = drive(speed_mps=8.0)
    rollout = with_newcomer(replay(scene), 40)
    scene.tracks.velocity_mps[0, :11] = (3.0, 4.0)  # The log says otherwise.

    velocity_mps = states_of(rollout, scene).velocity_mps

    assert velocity_mps[0, 10] == pytest.approx((3, 4))
    assert velocity_mps[0, 11:] == pytest.approx(np.tile((8.0, 0.0), (80, 1)), abs=1e-3)
    assert not velocity_mps[1, :41].any()
    assert velocity_mps[1, 41:] == pytest.approx(np.tile((8.0, 0.0), (50, 1)), abs=1e-3)


def test_a_single_step_has_no_velocity_and_gaps_do_not_count(drive):
    scene = drive(speed_mps=8.0)
    rollout = replay(scene)
    rollout.valid[0, 30:40] = False
    rollout.valid[0, 35] = True

    velocity_mps = states_of(rollout, scene).velocity_mps

    assert not velocity_mps[0, 35].any()
    assert velocity_mps[0, 40] == pytest.approx((8, 0), abs=1e-3)


def test_who_comes_after_the_cut_is_left_out(crossing):
    scene = crossing(steps=140)
    rollout = with_newcomer(replay(scene), 100)

    assert len(states_of(rollout, scene).id) == 4
    assert states_of(rollout, scene, 91).id.tolist() == [100, 101, 103]
    assert states_of(rollout, scene, 91).valid.shape == (3, 91)


def test_lights_are_the_logs_up_to_now_and_then_stay(drive, build_signals):
    rows = [(step, 7, SignalState.STOP) for step in range(5)]
    rows += [(step, 7, SignalState.GO) for step in range(5, 11)]
    rows += [(step, 7, SignalState.CAUTION) for step in range(11, 91)]
    rows += [(2, 3, SignalState.ARROW_GO), (50, 9, SignalState.GO)]
    scene = drive(signals=build_signals(sorted(rows)))

    lights = lights_of(scene, 120, "now")

    assert lights.lane_id.tolist() == [3, 7]  # Lane 9 has a light only later.
    assert lights.state[1, :5].tolist() == [SignalState.STOP] * 5
    assert (lights.state[1, 5:] == SignalState.GO).all()
    assert lights.state[0, 2] == SignalState.ARROW_GO
    assert (np.delete(lights.state[0], 2) == NO_LIGHT).all()
    assert lights.stop_xyz_m[0].tolist() == [1000, -2000, 10]


@pytest.mark.parametrize(("steps", "last"), [(91, 90), (94, 90), (95, 90), (96, 95)])
def test_lights_played_as_logged_stay_after_the_last_whole_half_second(
    drive, build_signals, steps, last
):
    rows = [(step, 7, SignalState(step % 3 + 4)) for step in range(steps)]
    rows.append((50, 9, SignalState.GO))
    scene = drive(steps=steps, signals=build_signals(sorted(rows)))

    lights = lights_of(scene, 120, "log")

    assert lights.lane_id.tolist() == [7, 9]  # Lane 9 has a light only after now.
    assert lights.state[0, : last + 1].tolist() == [s % 3 + 4 for s in range(last + 1)]
    assert (lights.state[0, last + 1 :] == last % 3 + 4).all()
    assert np.flatnonzero(lights.state[1] != NO_LIGHT).tolist() == [50]


@pytest.mark.parametrize("steps", [91, 93])
def test_lights_played_as_logged_are_those_that_the_network_sees(
    crossing, build_signals, steps
):
    rows = [(step, 1, SignalState(step // 7 % 9)) for step in range(steps)]
    scene = crossing(steps=steps, signals=build_signals(rows))
    seen = read_logged_signals(scene)
    known, tokens = seen.shown.shape[1], 30

    lights = lights_of(scene, CLOCK.end_step(tokens - 1) + 1, "log")

    ends = [CLOCK.end_step(token) for token in range(tokens)]
    told = hold_last_signals(seen.shown, known, tokens)[0] % REMEMBERED
    assert classify_signals(lights.state[0, ends]).tolist() == told.tolist()


@pytest.mark.parametrize("played", ["now", "log"])
def test_a_play_shorter_than_its_log_has_lights_for_as_long_as_it_lasts(
    drive, build_signals, played
):
    rows = [(step, 7, SignalState.STOP) for step in range(311)]
    scene = drive(steps=311, signals=build_signals([*rows, (200, 9, SignalState.GO)]))

    lights = lights_of(scene, 91, played)

    assert lights.state.tolist() == [[SignalState.STOP] * 91]


@pytest.mark.parametrize("played", ["now", "log"])
def test_a_scene_without_lights_has_none(drive, played):
    assert lights_of(drive(), 91, played).state.shape == (0, 91)
