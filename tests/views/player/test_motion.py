import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.views.player.motion import from_runs, to_runs

AGENTS, STEPS = 3, 9
PLACES = arrays(np.float32, (AGENTS, STEPS, 2), elements=st.floats(-5000, 5000, width=32))
HEADINGS = arrays(np.float32, (AGENTS, STEPS), elements=st.floats(-3.125, 3.125, width=32))
VALID = arrays(bool, (AGENTS, STEPS))


@settings(deadline=None)
@given(PLACES, HEADINGS, VALID)
def test_tracks_come_back_to_a_centimetre_and_a_milliradian(xy_m, heading_rad, valid):
    pose = np.concatenate([xy_m, heading_rad[..., None]], axis=-1)

    found, there = from_runs(to_runs(pose, valid), AGENTS, STEPS)

    np.testing.assert_array_equal(there, valid)
    away = (found - pose)[valid]
    # Half a centimetre, and what a float32 cannot hold of five kilometres.
    assert np.abs(away[:, :2]).max(initial=0) <= 0.006
    turned = (away[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max(initial=0) <= 0.001


def test_steady_motion_is_nearly_all_zeros():
    pose = np.zeros((1, 50, 3), np.float32)
    pose[0, :, 0] = 0.5 * np.arange(50)

    runs = to_runs(pose, np.ones((1, 50), bool))

    assert runs.change[:, 0].tolist() == [0, 50, *[0] * 48]
    assert not runs.change[:, 1:].any()


def test_a_gap_begins_a_new_run():
    valid = np.ones((2, 6), bool)
    valid[0, 2:4] = False

    runs = to_runs(np.zeros((2, 6, 3), np.float32), valid)

    assert runs.agent.tolist() == [0, 0, 1]
    assert runs.step.tolist() == [0, 4, 0]
    assert runs.length.tolist() == [2, 2, 6]


def test_a_turn_through_west_makes_no_jump():
    heading_rad = np.array([3.1, 3.14, -3.12, -3.08])
    pose = np.zeros((1, 4, 3), np.float32)
    pose[0, :, 2] = heading_rad

    runs = to_runs(pose, np.ones((1, 4), bool))

    assert np.abs(runs.change[:, 2]).max() < 50


def test_nobody_is_no_run():
    pose, valid = from_runs(
        to_runs(np.zeros((2, 4, 3), np.float32), np.zeros((2, 4), bool)), 2, 4
    )

    assert not valid.any()
    assert not pose.any()
