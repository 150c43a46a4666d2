import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from infgen.config import VocabSettings
from infgen.scene import AgentType
from infgen.tokens.clustering.physical_limits import (
    keeps_limits,
    motion_limits,
    plausible,
    smooth,
)

LIMITS = motion_limits(VocabSettings())
STEPS = np.arange(6)
KINDS = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)


def moves(*steps_xyh):
    """Paths from (x, y, heading) as arrays over steps or numbers."""
    return np.stack(
        [np.stack([np.broadcast_to(v, 6) for v in one], axis=-1) for one in steps_xyh]
    ).astype(np.float32)


def straight(speed_mps):
    return moves((0.1 * speed_mps * STEPS, 0, 0))


@pytest.mark.parametrize(("kind", "top_mps"), [(0, 45), (1, 6), (2, 15)])
def test_a_kind_may_go_as_fast_as_its_limit_and_no_faster(kind, top_mps):
    assert keeps_limits(straight(top_mps * 0.998), kind, LIMITS).all()
    assert not keeps_limits(straight(top_mps * 1.001), kind, LIMITS).any()
    assert not plausible(straight(top_mps * 1.001), kind, LIMITS).any()


def test_braking_at_twice_the_limit_is_not_possible():
    slowing = 20 * 0.1 * STEPS - 0.5 * 24 * (0.1 * STEPS) ** 2
    assert not keeps_limits(moves((slowing, 0, 0)), AgentType.VEHICLE, LIMITS).any()
    assert not plausible(moves((slowing, 0, 0)), AgentType.VEHICLE, LIMITS).any()


def test_a_jump_of_two_metres_within_a_drive_is_not_plausible():
    jumped = 10 * 0.1 * STEPS + 2.0 * (STEPS > 2)
    assert not plausible(moves((jumped, 0, 0)), AgentType.VEHICLE, LIMITS).any()


def test_a_vehicle_neither_slips_sideways_nor_speeds_backwards():
    aside = moves((0.1 * STEPS, 0.1 * STEPS, 0))
    assert not plausible(aside, AgentType.VEHICLE, LIMITS).any()
    assert not plausible(aside, AgentType.CYCLIST, LIMITS).any()
    assert plausible(aside, AgentType.PEDESTRIAN, LIMITS).all()
    assert plausible(straight(-3), AgentType.VEHICLE, LIMITS).all()
    assert not plausible(straight(-7), AgentType.VEHICLE, LIMITS).any()


def test_a_vehicle_that_turns_tightly_swings_its_centre_out():
    # 0.46 rad within 2 m, the rear axle 1.4 m behind the centre: seen in real logs.
    share = STEPS / 5
    turn = 0.46 * share
    x = 2.0 * share * np.cos(turn / 2) + 1.4 * (np.cos(turn) - 1)
    y = 2.0 * share * np.sin(turn / 2) + 1.4 * np.sin(turn)
    assert keeps_limits(moves((x, y, turn)), AgentType.VEHICLE, LIMITS).all()
    assert not keeps_limits(moves((x, -y, turn)), AgentType.VEHICLE, LIMITS).any()


def test_a_pedestrian_may_turn_round_and_a_vehicle_may_not():
    about = moves((0, 0, 3.0 * STEPS / 5))
    assert keeps_limits(about, AgentType.PEDESTRIAN, LIMITS).all()
    assert not keeps_limits(about, AgentType.VEHICLE, LIMITS).any()


def test_what_is_within_the_limits_is_left_alone():
    path = straight(12.3)
    np.testing.assert_array_equal(smooth(path, AgentType.VEHICLE, LIMITS), path)


def test_jitter_is_eased_until_it_is_within_the_limits_and_the_end_stays():
    jitter = 0.08 * np.array([0, 1, -1, 1, -1, 0])
    path = moves((0.8 * STEPS, jitter, 0.15 * jitter))
    assert plausible(path, AgentType.VEHICLE, LIMITS).all()
    assert not keeps_limits(path, AgentType.VEHICLE, LIMITS).any()
    eased = smooth(path, AgentType.VEHICLE, LIMITS)
    assert keeps_limits(eased, AgentType.VEHICLE, LIMITS).all()
    np.testing.assert_allclose(eased[:, [0, -1]], path[:, [0, -1]], atol=1e-6)
    assert 0 < np.abs(eased[:, 1:5, 1]).max() < np.abs(path[:, 1:5, 1]).max()


@given(
    hnp.arrays(np.float32, (6, 3), elements=st.floats(-1 / 16, 1 / 16, width=32)),
    st.floats(-2, 8),
    st.floats(-0.4, 0.4),
    st.sampled_from(KINDS),
)
def test_every_plausible_move_is_within_the_limits_once_eased(noise, ahead, turn, kind):
    share = (STEPS / 5)[:, None].astype(np.float32)
    path = (share * np.float32([ahead, ahead * turn / 2, turn]) + noise)[None]
    path[:, 0] = 0
    if plausible(path, kind, LIMITS).all():
        assert keeps_limits(smooth(path, kind, LIMITS), kind, LIMITS).all()
