"""Agents are told who comes near, pair by pair."""

from dataclasses import replace

import pytest
import torch

from infgen.model.features.approach import (
    INPUTS,
    MEETING_TOKENS,
    NEAR_M,
    ApproachFeatures,
    MovingPairs,
)

TOKENS, CLOSEST = 10, 11
"""Inputs of when and how near two agents come closest."""


@pytest.fixture
def features():
    torch.manual_seed(0)
    return ApproachFeatures(16)


def pairs(*agents, present=True):
    """Agents (x, y, heading, and the displacement); each sees all, itself included."""
    pose = torch.tensor([each[:3] for each in agents])
    count = len(agents)
    others = torch.arange(count).expand(count, count)
    return MovingPairs(
        pose,
        torch.tensor([each[3:] for each in agents]),
        torch.ones(count, dtype=torch.bool),
        torch.tensor([4.0, 2.0]).expand(count, 2),
        others,
        (others != torch.arange(count)[:, None]) & present,
    )


EAST = (0.0, 0.0, 0.0, 5.0, 0.0)
CROSSES = (20.0, -16.0, torch.pi / 2, 0.0, 4.0)


def test_two_agents_meet_when_and_where_they_would_at_constant_velocity():
    told = pairs(EAST, CROSSES).inputs()

    assert told.shape == (2, 2, INPUTS)
    for one, other in ((0, 1), (1, 0)):
        assert told[one, other, TOKENS] == pytest.approx(4 / MEETING_TOKENS)
        assert told[one, other, CLOSEST] == pytest.approx(1.0)


def test_who_drives_apart_is_closest_now_and_who_passes_is_close_later():
    apart = pairs(EAST, (-20.0, 0.0, torch.pi, -5.0, 0.0)).inputs()[0, 1]
    passes = pairs(EAST, (40.0, 3.0, torch.pi, -5.0, 0.0)).inputs()[0, 1]

    nearness = torch.tensor([-20 / NEAR_M, -3 / NEAR_M]).exp()
    assert apart[[TOKENS, CLOSEST]].tolist() == pytest.approx([0, nearness[0].item()])
    assert passes[TOKENS] == pytest.approx(4 / MEETING_TOKENS)
    assert passes[CLOSEST] == pytest.approx(nearness[1].item())


def test_they_are_the_same_wherever_the_scene_lies(features):
    def moved(agent):
        x_m, y_m, heading_rad, step_x_m, step_y_m = agent
        heading_rad = heading_rad + torch.pi / 2
        return (40.0 - y_m, 7.0 + x_m, heading_rad, -step_y_m, step_x_m)

    here, there = (
        features(pairs(*agents))
        for agents in ((EAST, CROSSES), map(moved, (EAST, CROSSES)))
    )

    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)


def test_only_agents_that_are_present_count(features):
    hidden = features(pairs(EAST, CROSSES, present=False))
    alone = pairs(EAST)

    torch.testing.assert_close(hidden[:1], features(alone))
    none = replace(alone, index=alone.index[:, :0], present=alone.present[:, :0])
    torch.testing.assert_close(hidden[:1], features(none))
    assert not torch.allclose(hidden, features(pairs(EAST, CROSSES)))


def test_how_an_agent_moved_before_it_was_inserted_does_not_count(
    tiny, new_network, inserted_twice
):
    network = new_network(replace(tiny, approach_features=True)).eval()
    seen = []
    network.motion.approach.register_forward_hook(
        lambda _, given, __: seen.append(given[0])
    )

    for each in inserted_twice:
        network(each)

    one, two = seen
    visible = inserted_twice[0].agents.visible
    row = visible.flatten().nonzero()[:, 0].tolist().index(4 * visible.shape[2] + 1)
    assert torch.equal(one.step_m[row], two.step_m[row])
    assert not one.step_m[row].any()
    assert not torch.equal(one.step_m, two.step_m)
