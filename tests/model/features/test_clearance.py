"""Motion tokens are told apart by the gaps to others that they would leave."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.features.anchors import ANCHORS, Anchors
from infgen.model.features.approach import MovingPairs
from infgen.model.features.clearance import AHEAD_M, BEHIND_M, TIMES_S, Clearance
from infgen.scene import AgentType

SIZE_LW_M = (4.0, 2.0)
AHEAD, BEHIND = len(AHEAD_M) * len(TIMES_S), len(BEHIND_M) * len(TIMES_S)
"""Features of others ahead and behind, followed by those of inserted ones."""


@pytest.fixture
def clearance(dense_moves):
    torch.manual_seed(0)
    return Clearance(16, 8, dense_moves)


@pytest.fixture
def anchors(dense_moves):
    return Anchors.of(dense_moves)


def pairs(*agents, known=True, present=True):
    """Agents (x, y, heading, and the displacement); each sees all, itself included."""
    count = len(agents)
    others = torch.arange(count).expand(count, count)
    return MovingPairs(
        torch.tensor([each[:3] for each in agents]),
        torch.tensor([each[3:] for each in agents]),
        torch.full((count,), known),
        torch.tensor(SIZE_LW_M).expand(count, 2),
        others,
        (others != torch.arange(count)[:, None]) & present,
    )


def vehicles(count):
    return torch.full((count,), int(AgentType.VEHICLE))


EAST = (0.0, 0.0, 0.0, 5.0, 0.0)
STANDS_AHEAD = (20.0, 0.0, 0.0, 0.0, 0.0)


def gaps_m(anchors, anchor, other, time_s):
    """Gaps along and beside, by hand, for a vehicle at the origin that heads along x."""
    end = anchors.end_pose[AgentType.VEHICLE, anchor]
    velocity_mps = anchors.velocity_mps[AgentType.VEHICLE, anchor]
    own_m = end[:2] + velocity_mps * (time_s - 0.5)
    their_m = np.array(other[:2]) + np.array(other[3:]) * time_s / 0.5
    turn = np.array([np.cos(end[2]), np.sin(end[2])])
    away_m = their_m - own_m
    along_m, beside_m = away_m @ turn, away_m @ np.array([-turn[1], turn[0]])
    turned = other[2] - end[2]
    length, width = SIZE_LW_M
    half_length_m = (
        abs(np.cos(turned)) * length + abs(np.sin(turned)) * width + length
    ) / 2
    half_width_m = (abs(np.sin(turned)) * length + abs(np.cos(turned)) * width + width) / 2
    return (
        along_m,
        max(0, abs(along_m) - half_length_m),
        max(0, abs(beside_m) - half_width_m),
    )


@pytest.mark.parametrize(
    "other",
    [STANDS_AHEAD, (12.0, -9.0, torch.pi / 2, 0.0, 3.0), (-9.0, 1.0, 0.1, 4.0, 0.4)],
)
def test_features_are_the_gaps_that_anchors_would_leave(clearance, anchors, other):
    told = clearance.features(vehicles(2), pairs(EAST, other))[0]

    assert told.shape == (ANCHORS, AHEAD * 5 // 4 + BEHIND * 5 // 4)
    for anchor in range(0, ANCHORS, 7):
        for time, time_s in enumerate(TIMES_S):
            along_m, gap_m, aside_m = gaps_m(anchors, anchor, other, time_s)
            for scales, first, counts in (
                (AHEAD_M, 0, along_m > 0),
                (BEHIND_M, AHEAD, along_m <= 0),
            ):
                for place, (scale_m, across_m) in enumerate(scales):
                    wanted = np.exp(-gap_m / scale_m - aside_m / across_m) if counts else 0
                    feature = told[anchor, first + place * len(TIMES_S) + time]
                    assert feature.item() == pytest.approx(wanted, abs=2e-4)
    assert not told[:, AHEAD + BEHIND :].any()


def test_others_that_were_just_inserted_have_features_of_their_own(clearance):
    moving = pairs(EAST, STANDS_AHEAD)
    told = clearance.features(vehicles(2), moving)[0]
    inserted = replace(moving, known=torch.tensor([True, False]))

    new = clearance.features(vehicles(2), inserted)[0]

    assert not new[:, : AHEAD + BEHIND].any()
    now = told[:, : AHEAD + BEHIND].view(ANCHORS, -1, len(TIMES_S))[..., 0]
    torch.testing.assert_close(new[:, AHEAD + BEHIND :], now)


def test_features_are_the_same_wherever_the_scene_lies(clearance):
    def moved(agent):
        x_m, y_m, heading_rad, step_x_m, step_y_m = agent
        return (40.0 - y_m, 7.0 + x_m, heading_rad + torch.pi / 2, -step_y_m, step_x_m)

    # At 10 m/s it would be right beside the one that stands after two seconds, where a
    # rounding error decides whether it counts as ahead or behind.
    east = (0.0, 0.0, 0.0, 4.7, 0.0)
    agents = (east, STANDS_AHEAD, (12.0, -9.0, torch.pi / 2, 0.0, 3.0))
    kind = torch.tensor([int(each) for each in AgentType])[[0, 1, 2]]

    here, there = (
        clearance.features(kind, pairs(*each)) for each in (agents, map(moved, agents))
    )

    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)


def test_only_agents_that_are_present_count(clearance):
    hidden = clearance.features(vehicles(2), pairs(EAST, STANDS_AHEAD, present=False))
    alone = pairs(EAST)

    assert not hidden.any()
    assert not clearance.features(vehicles(1), alone).any()
    none = replace(alone, index=alone.index[:, :0], present=alone.present[:, :0])
    assert not clearance.features(vehicles(1), none).any()


def test_only_the_nearest_to_come_count(clearance):
    far = [(300.0 + 10 * n, 300.0, 0.0, 0.0, 0.0) for n in range(20)]
    crowd = clearance.features(vehicles(22), pairs(EAST, *far, STANDS_AHEAD))[0]

    torch.testing.assert_close(
        crowd, clearance.features(vehicles(2), pairs(EAST, STANDS_AHEAD))[0]
    )


def test_rows_at_once_change_nothing(clearance, monkeypatch):
    moving = pairs(EAST, STANDS_AHEAD, (12.0, -9.0, 1.5, 0.0, 3.0))
    together = clearance.features(vehicles(3), moving)

    monkeypatch.setattr("infgen.model.features.anchors.ROWS", 2)

    assert torch.equal(together, clearance.features(vehicles(3), moving))


def test_motion_tokens_take_the_values_of_anchors_that_lead_as_far(anchors, dense_moves):
    share = anchors.share

    assert share.shape == (3, ANCHORS, dense_moves.num_motion_tokens)
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=1e-5)
    ends = np.einsum("kav,kad->kvd", share, anchors.end_pose[..., :2])
    away_m = np.linalg.norm(ends - dense_moves.end_pose[..., :2], axis=-1)
    assert away_m.mean() < 0.3


def test_short_motion_tokens_have_anchors_as_near(anchors, dense_moves):
    length_m = np.linalg.norm(dense_moves.end_pose[0, :, :2], axis=-1)
    ends = anchors.share[0].T @ anchors.end_pose[0, :, :2]
    away_m = np.linalg.norm(ends - dense_moves.end_pose[0, :, :2], axis=-1)

    slow, fast = away_m[length_m < 1.5].mean(), away_m[length_m > 6].mean()

    assert slow < fast / 2


def test_before_training_no_logit_changes_and_afterwards_tokens_are_told_apart(clearance):
    moving, x = pairs(EAST, STANDS_AHEAD), torch.randn(2, 16)
    clearance.begin_at_zero()
    assert not clearance(x, vehicles(2), moving).any()

    torch.nn.init.normal_(clearance.ask[-1].weight)
    judged = clearance(x, vehicles(2), moving)

    assert judged[0].std() > 0
    alone = clearance(x, vehicles(2), pairs(EAST, STANDS_AHEAD, present=False))
    assert not torch.allclose(judged[0], alone[0])


def test_what_anchors_are_worth_goes_to_the_tokens_of_each_agents_own_type(clearance):
    agent_type = torch.tensor([2, 0, 1, 0])
    judged = torch.randn(4, clearance.anchors)

    found = clearance.spread(judged, agent_type)

    each = zip(judged, clearance.share[agent_type], strict=True)
    expected = torch.stack([own @ share for own, share in each])
    torch.testing.assert_close(found, expected)
