"""Who is around the ego, comes and goes: scenes whose counts are known by hand."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.config import TokenSettings
from infgen.metrics.flow import FlowCounts, add_up, count_flow
from infgen.metrics.traffic import from_log, from_rollout
from tests.pipeline.stages.score.test_stage import as_rollout

TOKENS = 14
"""Token steps of 8 s that are looked at."""


@pytest.fixture
def played(parked):
    """The ego and two parked cars for 8 s."""
    return as_rollout(parked(count=2))


def count(rollout, radius_m=75.0):
    return count_flow(from_rollout(rollout), radius_m)


def other(rollout):
    """Row of a parked car."""
    return int(rollout.ego == 0)


def shown(rollout, *steps):
    """The rollout with one parked car there at some steps after now only."""
    valid = rollout.valid.copy()
    valid[other(rollout), :] = False
    for first, last in steps:
        valid[other(rollout), rollout.now + first : rollout.now + last + 1] = True
    return replace(rollout, valid=valid)


def test_whoever_stays_is_there_in_every_half_second_but_the_last_two(played):
    assert count(played) == FlowCounts(came=0, went=0, agents=2 * TOKENS, tokens=TOKENS)


def test_nobody_beyond_the_radius_counts(played):
    assert count(played, radius_m=0.5) == FlowCounts(0, 0, 0, TOKENS)


@pytest.mark.parametrize(
    ("steps", "came", "went", "ends"),
    [
        ([(6, 80)], 1, 0, TOKENS - 1),  # from the second half second on
        ([(70, 80)], 1, 0, 1),  # at the end of the last one that is looked at
        ([(71, 80)], 0, 0, 0),  # too late to be looked at
        ([(-10, 15)], 0, 1, 3),  # to the end of the third
        ([(-10, 0)], 0, 1, 0),  # to now
        ([(-10, -1)], 0, 0, 0),  # gone before
        ([(-10, 69)], 0, 1, TOKENS - 1),
        ([(-10, 70)], 0, 0, TOKENS),
        ([(6, 20), (31, 80)], 1, 0, 3 + 8),  # lost for a moment
    ],
)
def test_who_comes_and_goes_does_so_once(played, steps, came, went, ends):
    found = count(shown(played, *steps))

    assert (found.came, found.went) == (came, went)
    assert found.agents == TOKENS + ends


def test_who_drives_out_of_the_radius_has_gone_and_who_drives_in_has_come(played):
    """One car at 40 m drives away from the ego, the other towards it, 1 m a step."""
    out, into = np.flatnonzero(np.arange(3) != played.ego)
    xyz_m, step = played.xyz_m.copy(), np.arange(played.num_steps) - played.now
    ego = xyz_m[played.ego]
    xyz_m[out] = ego + np.stack([40 + step, 0 * step, 0 * step], axis=-1)
    xyz_m[into] = ego + np.stack([100 - step, 0 * step, 0 * step], axis=-1)

    found = count(replace(played, xyz_m=xyz_m.astype(np.float32)))

    assert (found.came, found.went) == (1, 1)
    assert found.agents == 6 + (TOKENS - 5)  # 40 + 34 m is near, 100 - 26 m too.


def test_a_log_is_counted_as_its_rollout_would_be(parked, played):
    logged = count_flow(from_log(parked(count=2), TokenSettings()), 75.0)

    assert logged == count(played)


def test_counts_add_up_to_rates():
    found = add_up([FlowCounts(3, 1, 20, 10), FlowCounts(1, 1, 0, 10)])

    assert found == FlowCounts(4, 2, 20, 20)
    assert found.per_token(found.came) == 0.2


def test_nothing_looked_at_has_no_rates():
    nothing = add_up([])

    assert np.isnan(nothing.per_token(nothing.agents))


def test_a_long_rollout_is_counted_in_windows_as_long_as_its_log(played):
    """8 s as two windows of 4 s: who is away in between comes and goes in both."""
    late, early = shown(played, (46, 80)), shown(played, (-10, 15))
    back = shown(played, (-10, 5), (71, 80))

    def windows(rollout):
        return count_flow(from_rollout(rollout), 75.0, temporal_window_tokens=8)

    assert windows(played) == FlowCounts(0, 0, agents=2 * 12, tokens=12)
    assert windows(late) == FlowCounts(1, 0, agents=12 + 5, tokens=12)
    assert windows(early) == FlowCounts(0, 1, agents=12 + 3, tokens=12)
    assert windows(back) == FlowCounts(0, 1, agents=12 + 1, tokens=12)
    assert count(back) == FlowCounts(0, 0, agents=14 + 1, tokens=14)


def test_windows_reach_from_the_first_half_second_to_the_last(played):
    """Three of 5 of 16 token steps: 0 to 5, 5.5 to 10.5 and 11 to 16."""
    late = shown(played, (66, 80))

    found = count_flow(from_rollout(late), 75.0, temporal_window_tokens=5)

    assert found.tokens == 3 * 3
    assert found == FlowCounts(1, 0, agents=9 + 1, tokens=9)
    assert count_flow(from_rollout(late), 75.0, temporal_window_tokens=99) == count(late)
