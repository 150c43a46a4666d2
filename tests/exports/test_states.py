import numpy as np
import pytest

from infgen.exports.states import NO_LIGHT, lights_of, states_of
from infgen.scene import SignalState
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

    lights = lights_of(scene, 120)

    assert lights.lane_id.tolist() == [3, 7]  # Lane 9 has a light only later.
    assert lights.state[1, :5].tolist() == [SignalState.STOP] * 5
    assert (lights.state[1, 5:] == SignalState.GO).all()
    assert lights.state[0, 2] == SignalState.ARROW_GO
    assert (np.delete(lights.state[0], 2) == NO_LIGHT).all()
    assert lights.stop_xyz_m[0].tolist() == [1000, -2000, 10]


def test_a_scene_without_lights_has_none(drive):
    assert lights_of(drive(), 91).state.shape == (0, 91)
