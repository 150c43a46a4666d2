"""Returns and advantages that can be worked out by hand."""

import torch

from infgen.model.training.policy_gradient.returns import advantages, discounted_returns


def test_rewards_count_less_for_each_token_step_that_they_come_later():
    reward = torch.tensor([0.0, 1.0, 0.0, 4.0]).view(1, 1, 4, 1)

    returns = discounted_returns(reward, 0.5)

    assert returns.flatten().tolist() == [1.0, 2.0, 2.0, 4.0]
    assert torch.equal(discounted_returns(reward, 0.0), reward)


def scene(returns):
    """Three rollouts of a scene: one token step, as many agents as there are columns."""
    returns = torch.tensor(returns)[:, None, None]
    some = torch.ones_like(returns, dtype=torch.bool)
    return returns, some, torch.zeros_like(some)


def test_the_return_of_an_agent_is_compared_with_its_own_in_the_other_rollouts():
    returns, moved, none = scene([[3.0, 5.0], [1.0, 5.0], [0.0, 8.0]])
    known = torch.ones(3, 1, 2, dtype=torch.bool)

    found = advantages(returns, moved, none, known)

    # The others of the first agent have 1 and 0, 3 and 0, 3 and 1.
    assert found[:, 0, 0, 0].tolist() == [2.5, -0.5, -2.0]
    assert found[:, 0, 0, 1].tolist() == [-1.5, -1.5, 3.0]


def test_an_agent_that_no_other_rollout_has_at_that_time_has_no_advantage():
    returns, moved, none = scene([[3.0], [1.0], [7.0]])
    moved[1:] = False

    found = advantages(returns, moved, none, torch.ones(3, 1, 1, dtype=torch.bool))

    assert not found.any()


def test_inserted_agents_are_compared_with_all_inserted_ones_of_other_rollouts():
    returns, moved, none = scene([[3.0, 5.0], [1.0, 5.0], [0.0, 8.0]])

    found = advantages(returns, moved, none, torch.zeros(3, 1, 2, dtype=torch.bool))

    # The mean of 1, 5, 0 and 8 is 3.5.
    assert found[0, 0, 0].tolist() == [-0.5, 1.5]


def test_insertions_are_compared_with_those_of_other_rollouts_at_any_time():
    returns = torch.tensor([[2.0, 0.0], [0.0, 5.0], [0.0, 1.0]])[:, None, :, None]
    inserted = torch.tensor([[True, False], [False, True], [False, True]])[:, None, :, None]

    found = advantages(
        returns, torch.zeros_like(inserted), inserted, torch.zeros(3, 1, 1).bool()
    )

    assert found[:, 0, :, 0].tolist() == [[-1.0, 0.0], [0.0, 3.5], [0.0, -2.5]]


def test_scenes_do_not_know_of_each_other():
    returns = torch.tensor([[3.0, 100.0], [1.0, 100.0], [0.0, 100.0]])[:, :, None, None]
    some = torch.ones_like(returns, dtype=torch.bool)

    found = advantages(returns, some, ~some, some[:, :, 0])

    assert found[:, 0, 0, 0].tolist() == [2.5, -0.5, -2.0]
    assert not found[:, 1].any()
