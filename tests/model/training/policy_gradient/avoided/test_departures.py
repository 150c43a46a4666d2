"""Motion tokens that drive off the road: boxes of 4 by 2 m, token k goes k metres."""

import numpy as np
import pytest
import torch

from infgen.model.training.policy_gradient.avoided.departures import (
    DRIVES_M,
    find_departures,
)
from infgen.model.training.policy_gradient.road import Road
from infgen.scene import AgentType
from infgen.spatial.road_edges import build_road_edges

NO_LANES = np.zeros((0, 3), dtype=np.float32)
LINES_M = [[[-100, -4, 0], [100, -4, 0]], [[100, 4, 0], [-100, 4, 0]]]
"""A road along x, 8 m wide."""
LEFT = np.pi / 2


@pytest.fixture(scope="module")
def road():
    edges = build_road_edges([np.array(line, dtype=np.float32) for line in LINES_M])
    return Road(edges, NO_LANES, NO_LANES)


def find(drawn, metres, road, way):
    return find_departures(drawn([[[pose] for pose in way]]), metres, [road])


def test_who_drives_off_the_road_is_told_which_tokens_stay_on_it(drawn, metres, road):
    # Heading across the road, its front is off it from y = 2 m on.
    found = find(drawn, metres, road, [[0, -1, LEFT], [0, 0, LEFT], [0, 4, LEFT]])

    assert found.at.tolist() == [[0, 2, 0]]
    assert found.avoided[0].tolist() == [metre > 2 for metre in range(24)]
    assert found.taken == 1


def test_who_stays_off_the_road_is_told_as_long_as_it_drives(drawn, metres, road):
    along = [[x, 8.0, 0.0] for x in (0, 5, 10, 10, 11)]

    found = find(drawn, metres, road, along)

    assert found.at[:, 1].tolist() == [1, 2, 4]
    assert not found.avoided[:, : int(np.ceil(DRIVES_M))].any()
    assert found.avoided[:, 1:].all()


def test_to_come_back_is_no_departure(drawn, metres, road):
    back = [[0, y, -LEFT] for y in (12, 9, 6, 3)]

    assert not find(drawn, metres, road, back).taken


def test_only_vehicles_depart(drawn, metres, road):
    rollouts = drawn([[[[0, 0, LEFT]], [[0, 4, LEFT]]]])
    rollouts.batch.agents.agent_type.fill_(int(AgentType.PEDESTRIAN))

    assert not find_departures(rollouts, metres, [road]).taken


def test_what_was_not_sampled_is_not_told(drawn, metres, road):
    rollouts = drawn([[[[0, 0, LEFT]], [[0, 4, LEFT]]]])
    rollouts.moved.fill_(False)

    found = find_departures(rollouts, metres, [road])

    assert found.taken == 0
    assert found.avoided.shape == (0, 24)


def test_every_rollout_has_the_road_of_its_scene(drawn, metres, road):
    ways = [[[[0, 0, LEFT]], [[0, 4, LEFT]]]] * 4
    nowhere = Road(None, NO_LANES, NO_LANES)

    found = find_departures(drawn(ways), metres, [nowhere, road])

    assert found.at[:, 0].tolist() == [1, 3]
    assert torch.equal(found.only(slice(2, 4)).at, found.at[1:] - torch.tensor([2, 0, 0]))
