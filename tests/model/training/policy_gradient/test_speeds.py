"""Cost of how fast vehicles drive."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.training.policy_gradient.speeds import speed_costs
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType

LAST = 3
"""The second token step behind the history."""


def driving(drawn, ours, logs):
    """Rollouts with agents that go so many metres in the last token step, in rollouts
    [rollout][agent] and in the log [agent]; before it they stand."""

    def path(ways_m):
        stands = [[4.0 * row, 9.0 * row, 0.0] for row in range(len(ways_m))]
        ends = [[x + way, y, 0.0] for (x, y, _), way in zip(stands, ways_m, strict=True)]
        return [stands] * LAST + [ends]

    rollouts = drawn([path(ways_m) for ways_m in ours])
    logged = replace(
        rollouts.logged, pose=torch.tensor([path(logs)] * len(ours), dtype=torch.float32)
    )
    moved = rollouts.moved.clone()
    moved[:, :LAST] = False
    return replace(rollouts, logged=logged, moved=moved)


def inserted_before(rollouts, rows, token):
    """The same with agents that were inserted at a token step, in the log as well."""
    known, inserted = rollouts.known.clone(), rollouts.inserted.clone()
    known[:, rows], inserted[:, token, rows] = False, True
    presence = rollouts.logged.presence.clone()
    presence[:, token, rows] = INSERTED
    logged = replace(rollouts.logged, presence=presence)
    return replace(rollouts, known=known, inserted=inserted, logged=logged)


def test_a_vehicle_is_compared_with_itself_in_the_log_and_in_other_rollouts(drawn):
    rollouts = driving(drawn, [[0, 2], [0, 0], [0, 1]], [0, 2])

    cost = speed_costs(rollouts)

    # In half a second. The distances to two others are summed up whole.
    expected = [[0, 0 - 6], [0, 4 - 6], [0, 2 - 4]]
    assert cost[:, LAST].tolist() == pytest.approx(np.array(expected))
    assert not cost[:, :LAST].any()


def test_all_rollouts_slower_than_the_log_cost_by_the_gap(drawn):
    rollouts = driving(drawn, [[0, 1]] * 3, [0, 2])

    cost = speed_costs(rollouts)

    assert cost[:, LAST].tolist() == [[0, 2]] * 3


def test_only_vehicles_are_compared(drawn):
    rollouts = driving(drawn, [[0, 1, 1]] * 3, [0, 2, 2])
    for agents in (rollouts.batch.agents, rollouts.logged):
        agents.agent_type[:, 2] = int(AgentType.PEDESTRIAN)

    cost = speed_costs(rollouts)

    assert cost[:, LAST].tolist() == [[0, 2, 0]] * 3


@pytest.mark.parametrize("token", [LAST - 1, LAST - 2])
def test_inserted_vehicles_are_compared_with_those_that_the_log_inserts(drawn, token):
    """In their first token step and later on."""
    rollouts = driving(drawn, [[3, 2], [3, 0]], [0, 2])

    cost = speed_costs(inserted_before(rollouts, [1], token))

    assert cost[:, LAST].tolist() == pytest.approx(np.array([[6, 0 - 4], [6, 4 - 4]]))


def test_a_first_token_step_is_not_compared_with_later_ones(drawn):
    rollouts = driving(drawn, [[3, 2], [3, 0]], [0, 2])
    rollouts = inserted_before(rollouts, [1], LAST - 1)
    presence = torch.roll(rollouts.logged.presence, -2, dims=1)  # Long before.

    cost = speed_costs(
        replace(rollouts, logged=replace(rollouts.logged, presence=presence))
    )

    assert not cost[:, :, 1].any()


def test_where_the_log_shows_no_vehicle_nothing_is_compared(drawn):
    rollouts = driving(drawn, [[0, 2], [0, 0]], [0, 2])
    observed = torch.zeros_like(rollouts.logged.observed)

    cost = speed_costs(
        replace(rollouts, logged=replace(rollouts.logged, observed=observed))
    )

    assert not cost.any()


def test_each_scene_has_its_own_log(drawn):
    """Rollouts lie scene by scene within a number."""
    rollouts = driving(drawn, [[0, 2], [3, 3], [0, 2], [3, 3]], [0, 2])
    rollouts = inserted_before(replace(rollouts, count=2), [1], LAST - 1)

    cost = speed_costs(rollouts)

    assert cost[::2, LAST].tolist() == [[0, 0]] * 2
    assert cost[1::2, LAST].tolist() == [[6, 2]] * 2
