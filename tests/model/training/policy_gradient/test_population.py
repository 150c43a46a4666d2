"""Cost of how many agents there are, and how many came."""

from dataclasses import replace

import pytest
import torch

from infgen.model.training.policy_gradient.population import count_costs
from infgen.model.training.simulation import INSERTED

LAST = 3
AGENTS = 4


def simulated(drawn, there, logged_there):
    """Rollouts in which as many agents are there [rollout][token], and in the log [token],
    from the second token step on; who is new was inserted."""
    stands = [[[9.0 * row, 0.0, 0.0] for row in range(AGENTS)]] * (LAST + 1)
    rollouts = drawn([stands] * len(there))
    own, log = (torch.tensor(each) for each in (there, [logged_there] * len(there)))
    row = torch.arange(AGENTS)
    own, log = row < own[..., None], row < log[..., None]
    inserted = own.clone()
    inserted[:, 1:] &= ~own[:, :-1]
    inserted[:, :2] = False
    logged = rollouts.logged
    presence = logged.presence.clone()
    presence[:, 1:][log[:, 1:] & ~log[:, :-1]] = INSERTED
    return replace(
        rollouts,
        moved=own & ~inserted,
        inserted=inserted,
        logged=replace(logged, observed=log, presence=presence),
    )


def test_an_agent_too_many_counts_as_one_there_and_one_that_came(drawn):
    there = [[2, 2, 3, 3], [2, 2, 2, 3], [2, 2, 2, 2]]

    cost = count_costs(simulated(drawn, there, [2, 2, 2, 2]))

    # Of three rollouts the distance to the other two is summed up whole.
    none = [0, 0]
    assert cost[0].tolist() == pytest.approx([*none, 2 - 2 * 2, 2 - 2])
    assert cost[1].tolist() == pytest.approx([*none, 0 - 2, 2 - 2])
    assert cost[2].tolist() == pytest.approx([*none, 0 - 2, 0 - 2 * 2])


def test_who_came_counts_even_if_somebody_left(drawn):
    there = [[2, 2, 3, 2]] * 3

    cost = count_costs(simulated(drawn, there, [2, 2, 2, 2]))

    assert cost[:, LAST].tolist() == pytest.approx([1] * 3)


def test_what_is_behind_the_log_costs_nothing(drawn):
    there = [[2, 2, 3, 0]] * 3

    cost = count_costs(simulated(drawn, there, [2, 2, 2, 0]))

    assert cost.tolist() == [[0, 0, 2, 0]] * 3
