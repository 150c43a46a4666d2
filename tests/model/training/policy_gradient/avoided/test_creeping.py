"""Motion tokens that creep on: token k goes k metres, so of them the first alone creeps."""

from dataclasses import replace

import numpy as np
import pytest

from infgen.model.training.policy_gradient.avoided.creeping import (
    AHEAD_M,
    ASIDE_M,
    CREPT_TOKENS,
    find_creeping,
)
from infgen.model.training.policy_gradient.rollouts import HISTORY_TOKENS
from infgen.scene import AgentType

METRES = 24


def way(*steps_m):
    """An agent that goes along x."""
    x_m = np.cumsum([0.0, *steps_m])
    return np.stack([x_m, 0 * x_m, 0 * x_m], axis=1)


def still(x_m, y_m, tokens):
    return np.tile([x_m, y_m, 0.0], (tokens, 1))


def find(drawn, metres, *ways):
    return find_creeping(drawn(np.stack(ways, axis=1)[None]), metres)


def test_who_has_crept_for_two_seconds_is_told_to_stop_or_to_speed_up(drawn, metres):
    found = find(drawn, metres, way(*[1] * (CREPT_TOKENS + 2), 3, 1))

    first = CREPT_TOKENS + 1
    assert found.at.tolist() == [[0, first, 0], [0, first + 1, 0]]
    assert found.avoided.tolist() == 2 * [[metre == 1 for metre in range(METRES)]]
    assert found.taken == 2


@pytest.mark.parametrize("other_m", [0, 2])
def test_who_has_stopped_or_driven_in_between_has_not_crept(drawn, metres, other_m):
    ways = [1] * (CREPT_TOKENS - 1) + [other_m] + [1] * CREPT_TOKENS

    assert not find(drawn, metres, way(*ways)).taken


@pytest.mark.parametrize(
    ("ahead_m", "aside_m", "waits"),
    [
        (AHEAD_M - 1, 0, True),
        (AHEAD_M + 1, 0, False),
        (3, ASIDE_M - 0.1, True),
        (3, ASIDE_M + 0.1, False),
        (-3, 0, False),
    ],
)
def test_who_is_behind_another_may_creep(drawn, metres, ahead_m, aside_m, waits):
    steps = [1] * (CREPT_TOKENS + 1)
    other = still(CREPT_TOKENS + ahead_m, aside_m, len(steps) + 1)

    assert bool(find(drawn, metres, way(*steps), other).taken) != waits


def test_an_agent_that_is_gone_is_none_to_wait_for(drawn, metres):
    steps = [1] * (CREPT_TOKENS + 1)
    other = still(CREPT_TOKENS + 5, 0, len(steps) + 1)
    rollouts = drawn(np.stack([way(*steps), other], axis=1)[None])
    assert not find_creeping(rollouts, metres).taken

    rollouts.batch.agents.observed[:, CREPT_TOKENS, 1] = False

    assert find_creeping(rollouts, metres).taken == 1


def test_only_vehicles_whose_tokens_were_sampled_creep(drawn, metres):
    rollouts = drawn(way(*[1] * (CREPT_TOKENS + 1))[None, :, None])
    rollouts.moved[:, 1] = False
    assert not find_creeping(rollouts, metres).taken

    rollouts.moved[:, 1] = True
    rollouts.batch.agents.agent_type.fill_(int(AgentType.CYCLIST))

    assert not find_creeping(rollouts, metres).taken


def test_only_what_is_more_than_in_the_logs_counts(drawn, metres):
    slow, fast = way(*[1] * (CREPT_TOKENS + 4)), way(*[3] * (CREPT_TOKENS + 4))
    rollouts = drawn(np.stack([slow, slow, slow], axis=0)[:, :, None])
    rollouts.moved[:, :HISTORY_TOKENS] = False  # As in rollouts.
    half, none = (
        drawn(np.stack(x, axis=0)[:, :, None])
        for x in ([slow, fast, fast], [fast, fast, fast])
    )

    excess = [
        find_creeping(replace(rollouts, logged=logged.batch.agents), metres).excess
        for logged in (rollouts, half, none)
    ]

    assert excess[0] == 0
    assert 0.5 < excess[1] < 1
    assert excess[2] == 1
