"""Removal is told where agents are to the ego, and nothing else changes."""

from dataclasses import replace

import pytest
import torch

from infgen.model.features.removal import EgoPlace, RemovalFeatures

RADIUS_M = 75.0


@pytest.fixture
def features():
    torch.manual_seed(0)
    return RemovalFeatures(16, RADIUS_M)


def ego_place(pose, ego_pose, before, ego_before, known=True):
    rows = [torch.tensor([each]) for each in (pose, ego_pose, before, ego_before)]
    return EgoPlace(*rows, torch.tensor([known]))


BEHIND = ((10.0, -20.0, 0.4), (13.0, 5.0, 1.2), (8.0, -20.0, 0.4), (11.0, 1.0, 1.2))


def test_removal_sees_them_and_motion_and_insertion_do_not(tiny, new_network, batch):
    network = new_network(replace(tiny, removal_features=True)).eval()
    before = network(batch)
    with torch.no_grad():
        network.motion.ego_place.embed[-1].bias += 1

    after = network(batch)

    assert torch.equal(before.motion.motion_logits, after.motion.motion_logits)
    assert torch.equal(before.entries.add_logit, after.entries.add_logit)
    assert not torch.equal(before.motion.remove_logit, after.motion.remove_logit)


def test_a_network_without_removal_has_none(tiny, new_network):
    network = new_network(replace(tiny, removal_features=True, remove_token=False))

    assert not network.added_parts()


def test_they_are_the_same_wherever_the_scene_lies(features):
    def moved(pose):
        x_m, y_m, heading_rad = pose
        return (40.0 - y_m, 7.0 + x_m, heading_rad + torch.pi / 2)

    here = features(ego_place(*BEHIND))
    there = features(ego_place(*map(moved, BEHIND)))

    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)


def test_they_tell_distance_direction_and_who_comes_nearer(features):
    pose, ego_pose, before, ego_before = BEHIND
    here = features(ego_place(*BEHIND))

    farther = features(ego_place((10.0, -30.0, 0.4), ego_pose, before, ego_before))
    other_way = features(ego_place(before, ego_before, pose, ego_pose))
    beside = features(ego_place(pose, (*ego_pose[:2], 0.2), before, ego_before))

    for each in (farther, other_way, beside):
        assert not torch.allclose(here, each)


def test_where_an_unseen_agent_was_before_does_not_count(features):
    pose, ego_pose, before, ego_before = BEHIND

    one = features(ego_place(pose, ego_pose, before, ego_before, known=False))
    two = features(ego_place(pose, ego_pose, (0.0, 0.0, 0.0), ego_before, known=False))

    assert torch.equal(one, two)


def test_who_is_inserted_was_nowhere_before(tiny, new_network, inserted_twice):
    alone = replace(tiny, removal_features=True, agent_agent_radius_m=0.0)
    network = new_network(alone).eval()
    with torch.no_grad():
        torch.nn.init.normal_(network.motion.ego_place.embed[-1].weight)

    one, two = (network(each).motion for each in inserted_twice)

    def removal(outputs):
        return outputs.rows.spread(outputs.remove_logit)[:, 4, 1]

    assert torch.equal(removal(one), removal(two))
