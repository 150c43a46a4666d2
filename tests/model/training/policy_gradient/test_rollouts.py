"""Rollouts of the network alone: what they are, and that they can be learned from."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from infgen.geometry import boxes_overlap
from infgen.model.batching.batch import collate
from infgen.model.batching.tensors import map_tensors
from infgen.model.training.own_choices import InsertedAgent
from infgen.model.training.policy_gradient.insertion_mask import find_free
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    simulate_rollouts,
)
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import FIRST_MOTION_TOKEN, Presence
from tests.model.training.policy_gradient.nuclei import nucleus_distribution

EGO, COUNT, TOP_P = 0, 3, 0.8


def tensors(batch):
    for part in (batch.agents, batch.entries, batch.details):
        for field in fields(part):
            yield field.name, getattr(part, field.name)


@pytest.fixture(scope="module")
def logged(record, limits):
    """Two scenes, the second one two token steps shorter."""
    lives = [(0, 11), (0, 11), (3, 11), (2, 6), (0, 5), (0, 1), (5, 11), (4, 11)]
    one = record(3, tokens=12, lives=lives, spread_m=20.0)
    return collate([one, record(4, agents=14, tokens=10, spread_m=25.0)], limits, 7)


@pytest.fixture(scope="module")
def restless(new_network):
    """A network that removes many agents."""
    network = new_network().eval()
    with torch.no_grad():
        network.motion.leave[-1].bias.fill_(-2.0)
    return network


@pytest.fixture(scope="module")
def rollouts(restless, logged):
    return simulate_rollouts(restless, logged, COUNT, TOP_P, seed=5)


def test_the_history_is_that_of_the_log_in_every_rollout(rollouts, logged):
    rows = logged.agents.presence.shape[2]
    for number in range(COUNT):
        batch = rollouts.only(number)
        for name in ("pose", "presence", "motion_token", "observed", "cell"):
            one = getattr(batch.agents, name)[:, :HISTORY_TOKENS, :rows]
            assert torch.equal(one, getattr(logged.agents, name)[:, :HISTORY_TOKENS]), name
    assert not rollouts.moved[:, :HISTORY_TOKENS].any()
    assert not rollouts.inserted[:, :HISTORY_TOKENS].any()


def test_afterwards_all_agents_are_inserted_live_and_are_removed_in_this_order(rollouts):
    presence = rollouts.batch.agents.presence
    before, after = (
        presence[:, HISTORY_TOKENS - 1 : -1],
        presence[:, HISTORY_TOKENS:],
    )
    alive = (before == int(Presence.PRESENT)) | (before == int(Presence.INSERTED))
    moved = rollouts.moved[:, HISTORY_TOKENS:]

    assert torch.equal(moved[:COUNT], alive[:COUNT] & moved[:COUNT])
    assert torch.equal((after == int(Presence.INSERTED)), rollouts.inserted[:, 2:])
    assert rollouts.inserted.any()
    assert (presence[:, HISTORY_TOKENS:] == int(Presence.REMOVED)).any()
    assert (presence[:, :, EGO] != int(Presence.REMOVED)).all()
    lives = (presence == int(Presence.INSERTED)).sum(dim=1)
    assert lives.max() == 1


def test_rollouts_end_where_their_logs_end(rollouts, logged):
    last = logged.agents.visible.any(dim=2).sum(dim=1)
    assert last.tolist() == [12, 10]

    there = rollouts.batch.agents.visible.any(dim=2).sum(dim=1)

    assert there.tolist() == [12, 10] * COUNT


def test_agents_that_are_there_at_the_end_of_the_history_are_known(rollouts, logged):
    presence = logged.agents.presence[:, HISTORY_TOKENS - 1]
    there = logged.agents.visible[:, HISTORY_TOKENS - 1]
    there &= presence != int(Presence.REMOVED)

    rows = there.shape[1]
    assert torch.equal(rollouts.known[:, :rows], there.repeat(COUNT, 1))
    assert not rollouts.known[:, rows:].any()
    assert torch.equal(rollouts.moved[:, HISTORY_TOKENS] & rollouts.known, rollouts.known)


def test_rollouts_of_a_scene_differ_and_equal_seeds_do_not(restless, logged, rollouts):
    same = simulate_rollouts(restless, logged, COUNT, TOP_P, seed=5)
    other = simulate_rollouts(restless, logged, COUNT, TOP_P, seed=6)

    pairs = zip(tensors(rollouts.batch), tensors(same.batch), strict=True)
    assert all(torch.equal(a, b) for (_, a), (_, b) in pairs)
    pose = rollouts.batch.agents.pose
    assert not torch.equal(pose, other.batch.agents.pose)
    assert not torch.equal(pose[rollouts.rows(0)], pose[rollouts.rows(1)])


def test_in_simulation_the_network_saw_what_it_learns_from(restless, rollouts):
    """In one pass over a rollout all that was sampled has the logits it was sampled by."""
    stationary = torch.from_numpy(restless.motion_vocabulary().stationary)
    for number in range(COUNT):
        batch = rollouts.only(number)
        with torch.no_grad():
            said = restless(batch)
        moved = rollouts.moved[rollouts.rows(number)][:, 1:]
        scene, token, row = moved.nonzero(as_tuple=True)
        logits = said.motion.rows.spread(said.motion.motion_logits)[scene, token, row]
        chosen = batch.agents.motion_token[scene, token + 1, row]
        apart = stationary[batch.agents.agent_type[scene, row]]
        likely = nucleus_distribution(logits, apart, TOP_P).gather(1, chosen[:, None])
        # Rounding may put one at the rim of its nucleus outside.
        assert (likely > 0).float().mean() > 0.99
        cell = batch.entries.cell[batch.entries.agent >= 0]
        assert len(cell) == rollouts.inserted[rollouts.rows(number)].sum()


def test_the_mode_of_the_network_and_the_batch_are_kept(new_network, logged):
    network = new_network().train()
    before = [tensor.clone() for _, tensor in tensors(logged)]

    simulate_rollouts(network, logged, COUNT, TOP_P, 0)

    assert network.training
    pairs = zip(tensors(logged), before, strict=True)
    assert all(torch.equal(now, then) for (_, now), then in pairs)


@pytest.mark.slow
def test_networks_of_all_kinds_can_be_simulated(variant, new_network, logged):
    found = simulate_rollouts(new_network(variant), logged, COUNT, TOP_P, 0)

    assert found.moved.any()
    assert found.inserted.any() == variant.insertion_and_removal


def test_a_scene_of_a_single_token_step_has_no_choices(new_network, record, limits):
    short = replace(limits, tokens=1)
    batch = collate([record(0, tokens=3)], short, 0)

    found = simulate_rollouts(new_network(), batch, COUNT, TOP_P, 0)

    assert not found.moved.any()


def test_with_an_insertion_mask_no_inserted_agent_overlaps_another(restless, logged):
    def overlapping(mask):
        found = simulate_rollouts(restless, logged, COUNT, TOP_P, 5, insertion_mask=mask)
        agents, share = found.batch.agents, []
        for rollout, token, row in found.inserted.nonzero().tolist():
            turn = agents.turn[rollout, token]
            before = agents.visible[rollout, token].clone()
            before &= ~found.inserted[rollout, token] | (turn < turn[row])
            before[row] = False
            walks = agents.agent_type[rollout] == int(AgentType.PEDESTRIAN)
            before &= ~(walks & walks[row])
            pose = agents.pose[rollout, token].numpy()
            size_lw_m = agents.size_lwh_m[rollout, :, :2].numpy()
            own = pose[[row]], size_lw_m[[row]]
            meets = boxes_overlap(*own, pose, size_lw_m)
            share.append((meets & before.numpy()).any())
        assert len(share) > 20
        return np.mean(share)

    assert overlapping(False) > 0
    assert overlapping(True) == 0


def test_an_agent_that_goes_on_as_it_does_makes_its_way_unfree(logged, new_network):
    vocabulary = new_network().motion_vocabulary()
    agents = map_tensors(logged.agents, Tensor.clone)
    agents = replace(agents, presence=torch.zeros_like(agents.presence))
    agents.presence[0, 0, 0] = int(Presence.PRESENT)
    fast = int(np.argmax(vocabulary.end_pose[0, :, 0]))
    ahead_m = float(vocabulary.end_pose[0, fast, 0])
    agents.pose[0, 0, 0] = torch.tensor([5.0, -3.0, 0.0])
    agents.agent_type[0, 0] = int(AgentType.VEHICLE)
    agents.size_lwh_m[0, 0] = torch.tensor([2.0, 1.0, 1.5])
    box = torch.tensor([[2.0, 1.0, 1.5]])
    vehicle = torch.tensor([int(AgentType.VEHICLE)])
    there = InsertedAgent(vehicle, torch.tensor([[5 + ahead_m, -3.0, 0.0]]), vehicle, box)

    def free(motion_token):
        agents.motion_token[0, 0, 0] = motion_token
        found = find_free(agents, 0, torch.tensor([0]), there, vocabulary.end_pose)
        return found.tolist()

    assert ahead_m > 4
    assert free(fast) == [False]
    assert free(FIRST_MOTION_TOKEN) == [True]
