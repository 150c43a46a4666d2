"""Costs of scenes that are drawn by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.training.policy_gradient.rewards import Costs, find_costs, log_distance
from infgen.model.training.policy_gradient.road import Road
from infgen.scene import AgentType
from infgen.spatial.road_edges import build_road_edges

NO_LANES = np.zeros((0, 3), dtype=np.float32)
NOWHERE = Road(None, NO_LANES, NO_LANES)
SOUTH, NORTH = [[0, -4, 0], [50, -4, 0]], [[50, 4, 0], [0, 4, 0]]
"""Road edges along x, 8 m apart, with the road on their left."""


def follow(distance_m):
    """One agent stands ten metres ahead; the other goes these distances."""
    return [[[x, 0, 0], [10, 0, 0]] for x in np.cumsum([0, *distance_m])]


def overlaps(rollouts, metres):
    return find_costs(rollouts, metres, [NOWHERE]).overlap


def test_who_runs_into_the_one_ahead_pays_once(drawn, metres):
    found = overlaps(drawn([follow([3, 3, 1, 1])]), metres)

    # 4 m long boxes whose centres are 4 m apart only touch; they overlap from 3 m on.
    assert found[0].tolist() == [[False] * 2] * 3 + [[True, False], [False] * 2]


def test_boxes_that_pass_through_each_other_within_a_token_step_overlap(drawn, metres):
    found = overlaps(drawn([follow([4, 14])]), metres)

    assert found[0, 2].tolist() == [True, False]


def test_two_who_meet_head_on_both_pay(drawn, metres):
    poses = [[[x, 0, 0], [12 - x, 0, np.pi]] for x in (0, 2, 5)]

    assert overlaps(drawn([poses]), metres)[0].tolist() == [
        [False] * 2,
        [False] * 2,
        [True] * 2,
    ]


def test_who_overlapped_from_the_beginning_does_not_pay(drawn, metres):
    poses = [[[x, 0, 0], [2, 0, 0]] for x in (0, 1)]

    assert not overlaps(drawn([poses]), metres).any()


def test_two_pedestrians_do_not_pay(drawn, metres):
    rollouts = drawn([follow([3, 3, 1, 1])])
    agents = rollouts.batch.agents
    agents.agent_type.fill_(int(AgentType.PEDESTRIAN))

    assert not overlaps(rollouts, metres).any()


@pytest.mark.parametrize("turns", [(-1, 0), (0, -1), (0, 1)])
def test_of_inserted_agents_the_last_to_come_pays(drawn, metres, turns):
    rollouts = drawn([[[[0, 0, 0], [9, 0, 0]], [[0, 0, 0], [2, 0, 0]]]])
    turn = torch.tensor(turns)
    rollouts.batch.agents.turn[0, 1] = turn
    rollouts.inserted[0, 1] = turn >= 0
    rollouts.moved[0, 1] = turn < 0

    assert overlaps(rollouts, metres)[0, 1].tolist() == [
        turn == max(turns) for turn in turns
    ]


def road(*lines):
    edges = build_road_edges([np.array(line, dtype=np.float32) for line in lines])
    return Road(edges, NO_LANES, NO_LANES)


def drift(*y_m):
    """One agent goes 5 m a token step along x, at these places across the road."""
    return [[[5 * (1 + at), y, 0]] for at, y in enumerate(y_m)]


def test_who_leaves_the_road_pays_as_long_as_it_gets_farther_off(drawn, metres):
    # Two metres wide: the side is off the road from y = 3 on.
    rollouts = drawn([drift(0, 2.5, 3.5, 3.9, 3.9, 3.5)])

    found = find_costs(rollouts, metres, [road(SOUTH, NORTH)]).off_road

    assert found[0, :, 0].tolist() == [False, False, True, True, False, False]


def test_who_is_far_off_the_road_may_go_where_it_likes(drawn, metres):
    rollouts = drawn([drift(6, 7, 9)])

    assert not find_costs(rollouts, metres, [road(SOUTH, NORTH)]).off_road.any()


def test_only_vehicles_pay_for_leaving_the_road(drawn, metres):
    rollouts = drawn([drift(0, 3.5)])
    rollouts.batch.agents.agent_type.fill_(int(AgentType.CYCLIST))

    assert not find_costs(rollouts, metres, [road(SOUTH, NORTH)]).off_road.any()


def test_near_a_lane_is_on_the_road():
    start_m, along_m = np.float32([[0, 6, 0]]), np.float32([[50, 0, 0]])
    edges = road(SOUTH, NORTH).edges
    pose, size_m = np.float32([[20, 6, 0]]), np.float32([[4, 2]])

    assert Road(edges, NO_LANES, NO_LANES).off_m(pose, size_m) == pytest.approx(3.0)
    # Its corners are a metre from the lane, 0.2 m within what counts as on it.
    assert Road(edges, start_m, along_m).off_m(pose, size_m) == pytest.approx(-0.2)


def test_the_log_distance_is_that_to_the_log_less_that_to_the_other_rollouts(drawn):
    """Rollouts are at 0, 1 and 9 m; the log is at 4 m."""
    rollouts = drawn([[[[0, 0, 0]], [[x, 0, 0]]] for x in (0, 1, 9)])
    logged = rollouts.logged.pose.clone()
    logged[:, 1, 0, 0] = 4
    rollouts = replace(rollouts, logged=replace(rollouts.logged, pose=logged))

    cost, score = log_distance(rollouts)

    roots = {8: 8**0.5, 3: 3**0.5, 5: 5**0.5}
    expected = [2 - (1 + 3), roots[3] - (1 + roots[8]), roots[5] - (3 + roots[8])]
    assert cost[:, 1, 0].tolist() == pytest.approx(expected)
    # (2 + sqrt 3 + sqrt 5) / 3 less half of the mean distance between two of them.
    mean = (2 + roots[3] + roots[5]) / 3 - (1 + 3 + roots[8]) / 3 / 2
    assert score[:, 1, 0].mean() == pytest.approx(mean)
    assert not cost[:, 0].any()


def test_with_two_rollouts_that_have_an_agent_only_the_log_counts(drawn):
    rollouts = drawn([[[[0, 0, 0]], [[x, 0, 0]]] for x in (0, 1, 9)])
    rollouts.moved[2] = False
    logged = rollouts.logged.pose.clone()
    logged[:, 1, 0, 0] = 4
    rollouts = replace(rollouts, logged=replace(rollouts.logged, pose=logged))

    cost, _ = log_distance(rollouts)

    assert cost[:, 1, 0].tolist() == pytest.approx([2, 3**0.5, 0])


def test_the_log_distance_teaches_the_energy_score_without_bias():
    """What one of two places gains over the other is the gradient of the energy score.

    The log is at x = 0 or 1 with equal odds; rollouts at 0 with the share ``p``. The score
    is E|X - y| - E|X - X'| / 2 = 1/2 - p (1 - p), whose gradient is 2 p - 1: rollouts are
    to be at 0 half of the time, not always.
    """
    group, p = 4, 0.7
    random = torch.Generator().manual_seed(0)
    x = (torch.rand((200_000, group), generator=random) > p).double()
    y = (torch.rand((200_000, 1), generator=random) > 0.5).double()
    away = (x[:, :, None] - x[:, None]).abs().sum(dim=2)
    cost = (x - y).abs() - away / (group - 2)
    baseline = (cost.sum(dim=1, keepdim=True) - cost) / (group - 1)
    # The gradient of log p(x) with respect to p.
    slope = torch.where(x == 0, 1 / p, -1 / (1 - p))

    gradient = ((cost - baseline) * slope).mean()

    assert gradient.item() == pytest.approx(2 * p - 1, abs=0.01)


def test_costs_are_weighed_by_the_settings():
    some = torch.tensor([[[True, False]]])
    distance = torch.tensor([[[2.0, -1.0]]])
    how = TrainSettings(
        overlap_penalty=3,
        off_road_penalty=5,
        log_distance_penalty=0.5,
        placement_penalty=2,
        speed_penalty=0.1,
        ego_speed_penalty=0.2,
    )

    costs = Costs(
        overlap=some,
        off_road=~some,
        log_distance=distance,
        energy_score=distance,
        placement=2 * distance,
        speed=10 * distance,
        agent_type=distance,
        count=distance[..., 0],
    )
    reward = costs.reward(how)

    assert reward.tolist() == [[[-16.0, 0.5]]]  # The first agent is the ego.
