from dataclasses import replace

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.metrics.long_term.radius import present_within_radius
from infgen.metrics.placement import (
    count_per_token,
    logged_events,
    simulated_events,
)
from infgen.rollout.rollout import NEVER, Rollout

STEPS = 91


def valid_from(first, last=STEPS):
    return (np.arange(STEPS) >= first) & (np.arange(STEPS) < last)


@pytest.fixture
def log(build_scene):
    """The ego stands at the origin, others 10, 20, 30 ... metres east of it."""

    def build(*valid):
        paths = [np.tile([10.0 * i, 0.0, 0.0], (STEPS, 1)) for i in range(len(valid) + 1)]
        return build_scene(
            np.stack(paths), [0] * len(paths), np.stack([valid_from(0), *valid])
        )

    return build


def events(scene):
    return logged_events(scene, TokenSettings())


def test_an_agent_enters_in_the_half_second_it_is_first_seen_in(log):
    # First seen at step 33: within token 6 (30 to 35), the fifth (number 4) after now.
    found = events(log(valid_from(33)))

    np.testing.assert_array_equal(found.entry_token, [4])
    np.testing.assert_allclose(found.entry_distance_m, [10.0])
    assert len(found.exit_token) == 0


def test_an_agent_leaves_in_the_last_half_second_it_is_seen_through(log):
    # Last seen at step 47: the last whole token is 8 (40 to 45), number 6 after now.
    found = events(log(valid_from(0), valid_from(0, 48)))

    np.testing.assert_array_equal(found.exit_token, [6])
    np.testing.assert_allclose(found.exit_distance_m, [20.0])
    assert len(found.entry_token) == 0


def test_who_is_there_now_or_at_the_end_neither_enters_nor_leaves(log):
    found = events(log(valid_from(0), valid_from(10), valid_from(4)))

    assert len(found.entry_token) == len(found.exit_token) == 0


def test_a_gap_is_neither_exit_nor_entry(log):
    gap = valid_from(0) & ~((np.arange(STEPS) > 40) & (np.arange(STEPS) < 60))
    found = events(log(gap))

    assert len(found.entry_token) == len(found.exit_token) == 0


def test_who_is_seen_for_less_than_two_half_seconds_does_not_count(log):
    found = events(log(valid_from(40, 47)))

    assert len(found.entry_token) == len(found.exit_token) == 0


def test_events_are_counted_by_half_second_and_radius():
    token = np.array([0, 2, 2, 9], np.int16)
    distance_m = np.array([10, 20, 80, np.nan], np.float32)

    assert count_per_token(token, distance_m, 75.0, 4).tolist() == [1, 0, 1, 0]
    assert count_per_token(token, distance_m, np.inf, 4).tolist() == [1, 0, 2, 0]
    assert count_per_token(token, distance_m, np.inf, 10)[9] == 1


def rollout(paths, valid, entry_step=None, exit_step=None) -> Rollout:
    count, steps = np.shape(valid)
    xyz = np.zeros((count, steps, 3), np.float32)
    xyz[..., 0] = paths
    xyz *= np.asarray(valid)[..., None]
    return Rollout(
        scenario_id="made",
        index=0,
        seed=0,
        weights="",
        origin_xyz_m=np.zeros(3),
        now=10,
        ego=0,
        id=np.arange(count, dtype=np.int32),
        agent_type=np.zeros(count, np.int8),
        size_lwh_m=np.ones((count, 3), np.float32),
        xyz_m=xyz,
        heading_rad=np.zeros((count, steps), np.float32),
        valid=np.asarray(valid),
        logged=np.ones(count, bool),
        entry_step=np.asarray(entry_step or [0] * count, dtype=np.int16),
        exit_step=np.asarray(exit_step or [NEVER] * count, dtype=np.int16),
    )


def test_simulated_events_by_hand():
    # Placed 31 m away at step 20 (the second half second after now), coming 1 m a step;
    # the other leaves at step 45 (the seventh), 20 m away.
    steps = np.arange(61)
    valid = np.stack([steps >= 0, steps > 20, steps <= 45])
    paths = np.stack([0 * steps, 31.0 - (steps - 20), 0 * steps + 20.0])
    found = simulated_events(rollout(paths, valid, [0, 20, 0], [NEVER, NEVER, 45]))

    assert found.entry_token.tolist() == [1]
    np.testing.assert_allclose(found.entry_distance_m, [31.0], atol=1e-4)
    assert found.exit_token.tolist() == [6]
    np.testing.assert_allclose(found.exit_distance_m, [20.0])


def test_log_and_simulation_agree_on_the_same_traffic(log):
    scene = log(valid_from(33), valid_from(0, 48))
    tracks = scene.tracks
    # As a simulator would write it: placed at the end of token 6, gone after token 8.
    valid = np.stack([valid_from(0), valid_from(36), valid_from(0, 46)])
    played = rollout(tracks.xyz_m[..., 0], valid, [0, 35, 0], [NEVER, NEVER, 45])

    one, two = events(scene), simulated_events(played)
    assert one.entry_token.tolist() == two.entry_token.tolist()
    assert one.exit_token.tolist() == two.exit_token.tolist()
    np.testing.assert_allclose(one.exit_distance_m, two.exit_distance_m)


def test_a_newcomer_of_the_last_step_is_counted_without_a_distance():
    steps = np.arange(31)
    played = rollout(np.zeros((2, 31)), [steps >= 0, steps > 30], [0, 30])
    found = simulated_events(played)

    assert found.entry_token.tolist() == [3]
    assert np.isnan(found.entry_distance_m).all()


def test_by_radius_agents_enter_and_leave_where_they_cross_the_circle():
    # One drives in from 60 m at 1 m a step (within 50 at step 10 + 10), one drives out
    # from 30 m (beyond 50 after step 30, read at step 35).
    steps = np.arange(61)
    paths = np.stack([0 * steps, 70.0 - steps, 20.0 + steps])
    lived = present_within_radius(rollout(paths, np.ones((3, 61), bool)), 50.0)
    found = simulated_events(lived)

    assert lived.entry_step.tolist() == [0, 20, 0]
    assert lived.exit_step.tolist() == [NEVER, NEVER, 30]
    assert not lived.valid[1, :21].any()
    assert lived.valid[1, 21:].all()
    assert not lived.valid[2, 31:].any()
    assert found.entry_token.tolist() == [1]
    np.testing.assert_allclose(found.entry_distance_m, [50.0], atol=1e-4)
    np.testing.assert_allclose(found.exit_distance_m, [50.0], atol=1e-4)


def test_by_radius_nobody_enters_twice():
    steps = np.arange(61)
    wave = 50.0 - 20.0 * np.sin(steps / 4.0)
    lived = present_within_radius(
        rollout(np.stack([0 * steps, wave]), np.ones((2, 61), bool)), 50.0
    )

    assert len(simulated_events(lived).entry_token) <= 1


def test_with_a_wide_radius_nothing_changes():
    steps = np.arange(61)
    played = rollout(np.stack([0 * steps, 30.0 + 0 * steps]), np.ones((2, 61), bool))
    lived = present_within_radius(played, 1000.0)

    np.testing.assert_array_equal(lived.valid, played.valid)
    np.testing.assert_array_equal(lived.xyz_m, played.xyz_m)
    assert replace(lived, xyz_m=played.xyz_m).exit_step.tolist() == [NEVER, NEVER]
