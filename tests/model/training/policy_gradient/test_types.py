"""Cost of the types of inserted agents."""

from dataclasses import replace

import pytest
import torch

from infgen.model.training.policy_gradient.types import type_costs
from infgen.model.training.simulation import INSERTED

LAST = 2
"""Token step at which agents are inserted here: the first after the history."""


def inserted_types(drawn, ours, logs):
    """Rollouts whose agents behind the first are inserted with types [rollout][agent], in
    the log with others [agent]; type -1 is not inserted."""
    stands = [[9.0 * row, 0.0, 0.0] for row in range(len(logs) + 1)]
    rollouts = drawn([[stands] * (LAST + 1) for _ in ours])
    own, log = torch.tensor(ours), torch.tensor([logs] * len(ours))
    inserted = torch.zeros_like(rollouts.inserted)
    inserted[:, LAST, 1:] = own >= 0
    presence = rollouts.logged.presence.clone()
    presence[:, LAST, 1:] = torch.where(log >= 0, INSERTED, presence[:, LAST, 1:])
    own_type, log_type = (torch.zeros_like(presence[:, 0]) for _ in range(2))
    own_type[:, 1:], log_type[:, 1:] = own.clamp(min=0), log.clamp(min=0)
    return replace(
        rollouts,
        batch=replace(
            rollouts.batch, agents=replace(rollouts.batch.agents, agent_type=own_type)
        ),
        logged=replace(rollouts.logged, presence=presence, agent_type=log_type),
        inserted=inserted,
    )


def test_a_type_costs_by_how_much_its_share_is_above_the_logs(drawn):
    cost = type_costs(inserted_types(drawn, [[0, 1], [1, 1]], [0, 1]))

    one, other = 0 / 3 - 1 / 2, 2 / 3 - 1 / 2
    expected = [0, one, other, 0, other, other]
    assert cost[:, LAST].ravel().tolist() == pytest.approx(expected)
    assert not cost[:, :LAST].any()


def test_who_is_not_inserted_costs_nothing(drawn):
    cost = type_costs(inserted_types(drawn, [[0, -1], [1, -1]], [0, 1]))

    assert cost[:, LAST].ravel().tolist() == pytest.approx([0, -0.5, 0, 0, -0.5, 0])


@pytest.mark.parametrize(
    ("ours", "logs"), [([[0, 1], [1, 1]], [-1, -1]), ([[0, -1], [-1, -1]], [0, 1])]
)
def test_without_a_log_or_another_one_nothing_is_compared(drawn, ours, logs):
    assert not type_costs(inserted_types(drawn, ours, logs)).any()


def test_each_scene_has_its_own_log(drawn):
    rollouts = inserted_types(drawn, [[0, 0], [1, 1], [0, 0], [1, 1]], [0, 0])

    cost = type_costs(replace(rollouts, count=2))

    assert cost[::2, LAST, 1:].ravel().tolist() == pytest.approx([0] * 4)
    assert cost[1::2, LAST, 1:].ravel().tolist() == pytest.approx([1] * 4)
