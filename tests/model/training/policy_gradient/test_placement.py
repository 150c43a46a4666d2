"""Cost of where vehicles are inserted."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.training.policy_gradient.placement import placement_costs
from infgen.model.training.policy_gradient.road import Road
from infgen.model.training.simulation import INSERTED
from infgen.scene import AgentType
from infgen.spatial.road_edges import build_road_edges

NO_LANES = np.zeros((0, 3), dtype=np.float32)
SOUTH, NORTH = [[0, -4, 0], [50, -4, 0]], [[50, 4, 0], [0, 4, 0]]
ROAD = Road(build_road_edges([np.float32(SOUTH), np.float32(NORTH)]), NO_LANES, NO_LANES)
ON, OFF = [20, 0, 0], [20, 15, 0]
"""More than a metre on the road, and off it."""
LAST = 2
"""Token step at which agents are inserted here: the first after the history."""


def inserted_at(drawn, ours, logs):
    """Rollouts whose agents behind the first are inserted at ``ours`` [rollout][agent], in
    the log at ``logs`` [agent]."""
    ego = [5, 0, 0]
    rollouts = drawn([[[ego, *poses]] * (LAST + 1) for poses in ours])
    logged = rollouts.logged
    pose, presence = logged.pose.clone(), logged.presence.clone()
    pose[:, LAST, 1:] = torch.tensor(logs, dtype=torch.float32)
    presence[:, LAST, 1:] = INSERTED
    inserted = torch.zeros_like(rollouts.inserted)
    inserted[:, LAST, 1:] = True
    logged = replace(logged, pose=pose, presence=presence)
    return replace(rollouts, logged=logged, inserted=inserted)


def test_more_off_the_road_than_in_the_log_costs_by_the_excess(drawn):
    rollouts = inserted_at(drawn, [[OFF, OFF], [OFF, ON]], [OFF, ON])

    cost = placement_costs(rollouts, [ROAD])

    # A vehicle off the road is 2 m from half of the log's and from one of three others; the
    # one on the road is so from half of the log's, and from all others.
    off, on = 1 - 2 / 3, 1 - 2
    assert cost[:, LAST].ravel() == pytest.approx([0, off, off, 0, off, on])
    assert not cost[:, :LAST].any()


def test_only_vehicles_have_a_place_off_the_road(drawn):
    rollouts = inserted_at(drawn, [[OFF, OFF], [OFF, ON]], [OFF, ON])
    rollouts.batch.agents.agent_type[:, 1] = int(AgentType.PEDESTRIAN)

    cost = placement_costs(rollouts, [ROAD])

    # The one vehicle of each rollout: the log's is on the road, ours is so in one of two.
    assert cost[:, LAST].ravel() == pytest.approx([0, 0, 2 - 2, 0, 0, 0 - 2])


def test_each_scene_has_its_own_log(drawn):
    """Rollouts lie scene by scene within a number; a map without edges costs nothing."""
    rollouts = inserted_at(drawn, [[OFF, OFF], [OFF, ON]] * 2, [OFF, ON])

    cost = placement_costs(rollouts, [ROAD, Road(None, NO_LANES, NO_LANES)])

    # The first scene has the first and the third rollout: all four are off the road.
    assert cost[::2, LAST].ravel() == pytest.approx([0, 1, 1, 0, 1, 1])
    assert not cost[1::2].any()
