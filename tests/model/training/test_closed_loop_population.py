"""Scenes with the network's own insertions and removals: what they are, what they teach."""

from dataclasses import fields, replace

import pytest
import torch

from infgen.config import TrainSettings
from infgen.geometry import boxes_overlap
from infgen.model.batching.batch import collate
from infgen.model.batching.insertion_targets import OUTSIDE
from infgen.model.batching.supervision import stay_mask
from infgen.model.training.closed_loop_population import (
    CORRECTION_TOKENS,
    close_population_loop,
)
from infgen.model.training.losses import losses, total
from infgen.scene import AgentType
from infgen.tokens.grid import from_grid, make_grid
from infgen.tokens.scene_tokens import NO_CELL, Presence

EGO = 0
NEVER, ALWAYS = -40.0, 40.0


def tensors(batch):
    for part in (batch.agents, batch.roads, batch.entries, batch.details):
        for field in fields(part):
            yield f"{type(part).__name__}.{field.name}", getattr(part, field.name)


@pytest.fixture(scope="module")
def logged(record, limits):
    lives = [(0, 11), (0, 11), (3, 11), (2, 6), (0, 5), (5, 11), (4, 11)]
    scene = record(3, tokens=12, lives=lives, spread_m=20.0)
    return collate([scene, record(4, agents=14, tokens=12, spread_m=25.0)], limits, 7)


@pytest.fixture(scope="module")
def restless(new_network):
    """A network that inserts and removes many agents."""
    return biased(new_network().eval(), remove=-1.5)


@pytest.fixture(scope="module")
def played(restless, logged):
    return close_population_loop(restless, logged, 3, seed=5)


def biased(network, *, add=None, remove=None):
    """The network with always, or never, an insertion or a removal."""
    with torch.no_grad():
        for head, bias in ((network.cells.add, add), (network.motion.leave, remove)):
            if bias is not None:
                head[-1].weight.zero_()
                head[-1].bias.fill_(bias)
        if add is not None and network.cells.cell_features is not None:
            network.cells.cell_features = None  # It adds to the odds of an insertion.
    return network


def far_from_ego(network, agents):
    """Whether agents are beyond the radius of the grid [scene, token, agent]."""
    away_m = (agents.pose[..., :2] - agents.pose[:, :, EGO, None, :2]).norm(dim=-1)
    return away_m > network.grid.radius_m


def test_agents_are_inserted_live_and_are_removed_in_this_order(played):
    presence = played.agents.presence
    before, after = presence[:, :-1], presence[:, 1:]
    gone = (before == int(Presence.ABSENT)) | (before == int(Presence.REMOVED))
    free = (after == int(Presence.ABSENT)) | (after == int(Presence.INSERTED))

    assert torch.equal(gone, free)
    assert not (played.agents.observed & (presence == int(Presence.ABSENT))).any()
    assert (presence[:, :, EGO] != int(Presence.REMOVED)).all()


def test_somebody_is_missing_somebody_surplus_and_somebody_inserted_again(
    restless, logged, played
):
    rows = logged.agents.presence.shape[2]
    there = logged.agents.visible
    simulated = played.agents.visible[..., :rows]

    assert played.agents.presence.shape[2] > rows
    assert (there & ~simulated).any()
    assert (simulated & ~there).any()
    assert played.agents.visible[..., rows:].any()
    assert any(
        (each.agents.presence == int(Presence.INSERTED)).sum(dim=1).max() > 1
        for each in (close_population_loop(restless, logged, 3, seed) for seed in range(12))
    )


def test_rows_for_inserted_agents_last_until_the_end_of_a_long_log(
    new_network, record, limits
):
    """One agent a token step is inserted in the mean, and the log inserts none."""
    network = biased(new_network().eval(), add=0.0, remove=NEVER)
    scene = record(3, tokens=40, lives=[(0, 39)], spread_m=15.0)
    logged = collate([scene] * 4, replace(limits, tokens=40), 7)
    rows = logged.agents.presence.shape[2]

    played = close_population_loop(network, logged, 3, seed=1)

    inserted = played.agents.presence[..., rows:] == int(Presence.INSERTED)
    assert inserted[:, 30:39].any(dim=2).float().mean() > 0.3
    assert inserted.any(dim=1).any(dim=0).all()  # No row is left without an agent.


def test_each_insertion_has_its_turn_and_its_place(logged, played, grid_settings):
    agents, entries = played.agents, played.entries
    inside = (agents.turn >= 0) & (agents.turn < OUTSIDE)

    inside &= entries.asked[..., None]
    assert (inside.sum(dim=2) >= entries.count).all()
    assert ((agents.presence == int(Presence.INSERTED)) | ~inside).all()
    assert (agents.cell[inside] != NO_CELL).all()
    scene, token, row = inside.nonzero(as_tuple=True)
    rows = logged.agents.presence.shape[2]
    known = row < rows
    pose = agents.pose[scene, token, row]
    at = scene[known], token[known], row[known]
    assert torch.equal(pose[known], logged.agents.pose[at])
    grid = make_grid(grid_settings)
    cell = agents.cell[scene, token, row][~known]
    ego_pose = agents.pose[scene, token, EGO][~known]
    centre_m = from_grid(grid.centre_m[cell.numpy()], ego_pose.numpy())
    away_m = pose[~known][:, :2].numpy() - centre_m
    assert abs(away_m).max() < 1.5 * grid.step_m


def test_agents_are_inserted_as_the_network_samples_them_if_the_settings_say_so(
    restless, logged
):
    rows = logged.agents.presence.shape[2]

    played = close_population_loop(restless, logged, 3, seed=5, own_share=1.0)

    agents, entries = played.agents, played.entries
    inside = (agents.presence == int(Presence.INSERTED)) & (agents.turn >= 0)
    inside &= (agents.turn < OUTSIDE) & entries.asked[..., None]
    assert inside[..., rows:].any()
    assert not inside[..., :rows].any()
    slot = torch.arange(entries.add.shape[2])
    assert entries.count.any()
    assert entries.add[(slot < entries.count[..., None]) & entries.asked[..., None]].all()
    assert torch.equal(
        entries.count[entries.asked].clamp(max=1),
        (inside.any(dim=2) & entries.add[..., 0])[entries.asked].long(),
    )
    assert (entries.agent >= 0).any()


def test_insertions_to_learn_come_first_and_those_named_are_missing(logged, played):
    entries, agents = played.entries, logged.agents
    slot = torch.arange(entries.add.shape[2])
    decided = slot <= entries.count[..., None]
    add = entries.add & decided & entries.asked[..., None]

    assert add.any()
    assert (add[..., 1:] <= add[..., :-1] | ~decided[..., 1:]).all()
    scene, token, turn = (entries.agent >= 0).nonzero(as_tuple=True)
    row = entries.agent[scene, token, turn]
    assert add[scene, token, turn].all()
    assert agents.visible[scene, token, row].all()
    took = played.agents.turn[scene, token, row]
    assert ((took == turn) | (took == -1)).all()
    assert torch.equal(
        entries.cell[scene, token, turn], played.agents.cell[scene, token, row]
    )


def test_no_agent_of_the_log_is_inserted_onto_a_simulated_one(restless, record, limits):
    lives = [(0, 11), *[(0, 4)] * 6, *[(3, 11)] * 6]
    scene = record(3, tokens=12, lives=lives, spread_m=12.0)
    logged = collate([scene] * 6, limits, 7)
    rows = logged.agents.presence.shape[2]

    agents = close_population_loop(restless, logged, 3, seed=2).agents

    inserted = (agents.presence == int(Presence.INSERTED)) & (agents.turn >= 0)
    inserted &= (agents.turn < OUTSIDE) & (torch.arange(inserted.shape[2]) < rows)
    stays = agents.observed & (agents.presence == int(Presence.PRESENT))
    scene, token, row = inserted.nonzero(as_tuple=True)
    place, other = stays[scene, token].nonzero(as_tuple=True)
    scene, token, row = scene[place], token[place], row[place]
    overlaps = boxes_overlap(
        agents.pose[scene, token, row].numpy(),
        agents.size_lwh_m[scene, row, :2].numpy(),
        agents.pose[scene, token, other].numpy(),
        agents.size_lwh_m[scene, other, :2].numpy(),
    )
    walks = int(AgentType.PEDESTRIAN)
    both_walk = (agents.agent_type[scene, row] == walks) & (
        agents.agent_type[scene, other] == walks
    )
    assert len(place) > 100
    assert not overlaps[~both_walk.numpy()].any()


def test_a_network_that_inserts_nobody_is_to_insert_more_than_the_log_does(
    new_network, logged
):
    network = biased(new_network().eval(), add=NEVER, remove=NEVER)

    wanted, came = 0, 0
    for seed in range(8):
        played = close_population_loop(network, logged, 3, seed)
        assert (played.entries.count == 0).all()
        wanted += int(played.entries.add[..., 0].sum())
        came += int((logged.entries.count[:, 1:] > 0).sum())

    assert wanted > came


def test_a_network_that_removes_everybody_is_to_remove_fewer_and_insert_more(
    new_network, logged
):
    network = biased(new_network().eval(), add=NEVER, remove=ALWAYS)

    played = close_population_loop(network, logged, 3, 0)

    # The first decision is on the second token step.
    others = played.agents.presence[:, 2:, 1:]
    told = logged.agents.told[:, 1].any(dim=1, keepdim=True)
    stayed = played.agents.presence[:, 1, 1:] == int(Presence.PRESENT)
    assert not (stayed & told).any()
    assert (others == int(Presence.PRESENT)).sum() < (
        logged.agents.presence[:, 2:, 1:] == int(Presence.PRESENT)
    ).sum()
    assert played.entries.add[:, 2:, 0].float().mean() > 0.5


def test_a_network_that_inserts_always_is_to_remove_some_surplus_and_to_keep_the_rest(
    new_network, logged
):
    network = biased(new_network().eval(), add=ALWAYS, remove=NEVER)

    played = close_population_loop(network, logged, 3, 0)

    agents, rows = played.agents, logged.agents.presence.shape[2]
    removal, told = agents.removal[:, 1:, rows:], agents.told[:, 1:, rows:]
    known = logged.agents.told[:, 1:].any(dim=2, keepdim=True).expand_as(told)
    surplus = known & agents.visible[:, :-1, rows:] & agents.observed[:, 1:, rows:]
    near = ~far_from_ego(network, agents)[:, :-1, rows:]
    assert told[surplus].all()
    assert removal[surplus & near].any()
    assert not removal[surplus & near].all()
    mask = stay_mask(agents)
    assert not (mask[:, :-1] & ~agents.told[:, 1:]).any()
    assert not played.entries.add[:, 3:, 1:].any()


def test_all_beyond_the_radius_are_to_be_removed_but_as_many_as_the_log_has_there(
    new_network, record, limits
):
    network = biased(new_network().eval(), add=NEVER, remove=NEVER)
    lives = [*[(0, 11)] * 12, *[(0, 3)] * 12]
    logged = collate([record(3, tokens=12, lives=lives, spread_m=70.0)] * 2, limits, 7)
    rows = logged.agents.presence.shape[2]

    agents = close_population_loop(network, logged, 0, 0).agents

    far = far_from_ego(network, agents)[:, :-1]
    there = (agents.visible & (agents.presence != int(Presence.REMOVED)))[:, :-1]
    logs = logged.agents.visible & (logged.agents.presence != int(Presence.REMOVED))
    logs = (logs & far_from_ego(network, logged.agents))[:, :-1]
    surplus = there & far
    surplus[..., :rows] &= ~logged.agents.visible[:, 1:]
    more = ((there & far).sum(dim=2) - logs.sum(dim=2)).clamp(min=0)
    wanted = (agents.removal[:, 1:] & surplus).sum(dim=2)
    assert logs.any()
    assert logged.agents.told[:, 1:10].any(dim=2).all()
    assert (more[:, 5:9] > 1).all()
    assert torch.equal(wanted[:, 5:9], more[:, 5:9])


@pytest.mark.parametrize("add", [None, NEVER, ALWAYS])
def test_no_turn_is_learned_that_a_log_would_not_have(
    new_network, record, limits, logged, add
):
    """Else "are there three?" would be asked of all token steps, not of those with two."""
    if add == ALWAYS:  # So many come at once that there is more than one turn.
        lives = [(0, 5), *[(2, 5)] * 3]
        logged = collate([record(3, tokens=6, lives=lives, spread_m=15.0)], limits, 7)
    played = close_population_loop(biased(new_network().eval(), add=add), logged, 3, 0)

    entries = played.entries
    slot = torch.arange(entries.add.shape[2])
    before_the_last = (slot < entries.count[..., None]) & entries.asked[..., None]
    assert entries.add[before_the_last].all()
    number = entries.add.sum(dim=2)[entries.asked]
    if add == ALWAYS:
        assert torch.equal(entries.count[entries.asked], number)
        assert number.max() > 1
    if add == NEVER:
        assert not entries.count.any()


def test_a_share_of_the_excess_is_corrected_by_insertions(new_network, record, limits):
    """Five agents are missing and no new one comes: one is to be inserted now and then."""
    network = biased(new_network().eval(), add=NEVER, remove=NEVER)
    lives = [(0, 11), *((token, 11) for token in range(2, 7))]
    scene = record(3, tokens=12, lives=lives, spread_m=15.0)
    logged = collate([scene] * 80, limits, 7)  # Each draws numbers of its own.
    assert (logged.agents.visible[:, 9].sum(dim=1) == 7).all()

    wanted = close_population_loop(network, logged, 3, 0).entries.add[:, 9, 0]

    share = 5 / (2 * CORRECTION_TOKENS)
    assert wanted.float().mean() == pytest.approx(share, abs=0.17)


def test_as_many_are_to_be_removed_as_the_log_removes_whomever_the_network_has_removed(
    new_network, record, limits
):
    """Half of the agents are gone by the time that the log removes them."""
    network = biased(new_network().eval(), add=NEVER, remove=-2.0)
    lives = [*[(0, 11)] * 8, *((0, last) for last in range(3, 11))]
    scene = record(3, tokens=12, lives=lives, spread_m=15.0)
    logged = collate([scene] * 60, limits, 7)
    other = record(4, tokens=12, lives=[(0, 11)] * 8, spread_m=15.0)
    calm = collate([other] * 60, limits, 7)

    played = close_population_loop(network, logged, 3, 0).agents
    none = close_population_loop(network, calm, 3, 0).agents

    before = played.visible[:, :-1] & (played.presence[:, :-1] != int(Presence.REMOVED))
    left = (played.removal[:, 1:] & before).sum(dim=(1, 2)).float()
    # Too few are left, so that removals are taken back, one of twelve missing a token step.
    missing = logged.agents.visible.sum(dim=2) - played.visible.sum(dim=2)
    back = missing[:, 1:-1].sum(dim=1) / (2 * CORRECTION_TOKENS)
    assert (left + back.clamp(max=8)).mean() == pytest.approx(8, abs=1.5)
    assert not none.removal.any(), "the log removes none"


def test_what_cannot_be_corrected_yet_is_corrected_later(new_network, record, limits):
    """Two too many for seven token steps without an insertion, and two too few."""
    keeps = biased(new_network().eval(), add=NEVER, remove=NEVER)
    many = record(3, tokens=12, lives=[(0, 11), (0, 1), (0, 1), (9, 11)], spread_m=15.0)
    few = record(3, tokens=12, lives=[(0, 11), (2, 11), (2, 11), (0, 9)], spread_m=15.0)
    logged = collate([many, few] * 20, limits, 7)  # Each begins to correct anywhere.
    assert logged.entries.add[::2, 9, 0].all()
    assert logged.agents.removal[1::2, 9].any(dim=1).all()

    played = close_population_loop(keeps, logged, 3, 0)

    assert not played.entries.add[::2, 9, 0].any()
    assert not played.agents.removal[1::2, 9].any()


def test_surplus_agents_teach_no_motion(logged, played):
    rows = logged.agents.presence.shape[2]
    surplus = played.agents.observed.clone()
    surplus[..., :rows] &= ~logged.agents.visible

    assert surplus.any()
    assert (played.agents.label[surplus] < 0).all()


def test_equal_seeds_simulate_equally_and_others_do_not(restless, logged, played):
    same = close_population_loop(restless, logged, 3, seed=5)
    other = close_population_loop(restless, logged, 3, seed=6)

    pairs = zip(tensors(played), tensors(same), strict=True)
    assert all(torch.equal(a, b) for (_, a), (_, b) in pairs)
    assert not torch.equal(played.agents.presence, other.agents.presence)


def test_the_batch_and_the_mode_of_the_network_are_kept(new_network, logged):
    network = new_network().train()
    before = [tensor.clone() for _, tensor in tensors(logged)]

    close_population_loop(network, logged, 3, 0)

    assert network.training
    pairs = zip(tensors(logged), before, strict=True)
    assert all(torch.equal(now, then) for (_, now), then in pairs)


def test_in_simulation_the_network_saw_what_it_learns_from(restless, played):
    """Logits of one pass over the scene simulated are those that it was simulated with."""
    with torch.no_grad():
        said = restless(played)
    agents = played.agents
    moved = agents.observed.clone()
    moved[:, 1:] &= agents.visible[:, :-1]
    scene, token, row = moved[:, 1:].nonzero(as_tuple=True)
    logits = said.motion.rows.spread(said.motion.motion_logits)[scene, token, row]
    likely = logits.topk(3).indices
    taken = agents.motion_token[scene, token + 1, row]

    assert (likely == taken[:, None]).any(dim=1).all()


def test_what_was_simulated_can_be_learned_from(variant, new_network, logged):
    network = new_network(variant)
    if network.cells is None:
        with pytest.raises(ValueError, match="that has neither"):
            close_population_loop(network, logged, 3, 0)
        return
    settings = TrainSettings(label_smoothing=0.0)

    played = close_population_loop(network, logged, 3, 0)
    loss = total(losses(network(played), played, settings), settings)
    loss.backward()

    assert torch.isfinite(loss)
    heads = [network.motion, network.cells, network.details]
    for head in heads:
        gradients = [p.grad for p in head.parameters() if p.grad is not None]
        assert max(float(g.abs().max()) for g in gradients) > 0


def test_agents_of_the_log_move_as_the_batch_has_it_if_nothing_is_chosen(restless, logged):
    played = close_population_loop(restless, logged, 0, 3)

    rows = logged.agents.presence.shape[2]
    same = played.agents.observed[..., :rows] & logged.agents.observed
    assert same.any()
    assert (played.agents.observed[..., :rows] & ~same).any()
    for name in ("pose", "motion_token"):
        one, two = getattr(played.agents, name)[:, :, :rows], getattr(logged.agents, name)
        moved = same & (played.agents.label[..., :rows] >= 0)
        assert torch.equal(one[moved], two[moved]), name


def test_the_log_and_targets_of_a_batch_as_logged_agree(logged):
    agents, entries = logged.agents, logged.entries
    removed = agents.presence == int(Presence.REMOVED)

    assert torch.equal(agents.removal, removed)
    assert torch.equal(entries.add, entries.agent >= 0)
