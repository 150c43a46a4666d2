"""Scenes played by the network, close to the log: what is kept, what follows from what."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.batching.insertion_targets import OUTSIDE
from infgen.model.batching.recovery import Recovery
from infgen.model.training.closed_loop import close_loop
from infgen.model.training.losses import losses, total
from infgen.tokens.grid import decode_cell, encode_cell, from_grid, make_grid, to_grid
from infgen.tokens.motion_tokens import (
    advance,
    follow,
    make_match_table,
    nearest_motion_tokens,
)
from infgen.tokens.scene_tokens import NO_CELL, NO_MOTION_TOKEN, Presence

NUM_MOVES = 24


def tensors(batch):
    for part in (batch.agents, batch.roads, batch.entries, batch.details):
        for field in fields(part):
            yield f"{type(part).__name__}.{field.name}", getattr(part, field.name)


def with_a_gap(scene):
    """The scene with row 1 unseen for two tokens, then going on."""
    observed, motion_token = scene.observed.copy(), scene.motion_token.copy()
    observed[1, 3:5], motion_token[1, 3:5] = False, NO_MOTION_TOKEN
    return replace(scene, observed=observed, motion_token=motion_token)


@pytest.fixture(scope="module")
def logged(record, limits):
    """Scenes with inserted agents, leavers, a gap and padding, all written exactly."""
    lives = [(0, 8), (0, 8), (3, 8), (2, 6), (0, 5), (5, 8), (4, 8)]
    scene = with_a_gap(record(3, tokens=9, lives=lives, spread_m=20.0))
    batch = collate([scene, record(4, agents=14, spread_m=25.0)], limits, 7)
    gap = (batch.agents.presence == Presence.PRESENT) & ~batch.agents.observed
    assert gap.any()
    assert (batch.entries.agent >= 0).sum() > 3
    return batch


@pytest.fixture(scope="module")
def blurred(logged):
    """The same with poses that no moves lead to, and moves that are none."""
    agents = logged.agents
    made = torch.zeros_like(agents.observed)
    made[moves_made(logged)] = True
    motion_token = torch.where(made, NUM_MOVES, agents.motion_token)
    noise = torch.randn(agents.pose.shape, generator=torch.Generator().manual_seed(0))
    blur = noise * torch.tensor([0.1, 0.1, 0.03]) * agents.observed[..., None]
    return replace(
        logged, agents=replace(agents, pose=agents.pose + blur, motion_token=motion_token)
    )


@pytest.fixture(scope="module")
def played(network, logged):
    """The network's own choice of three."""
    return close_loop(network, logged, 3)


def moves_made(played):
    """Index (scene, token, row) of all moves from one seen token to the next."""
    agents = played.agents
    made = agents.observed.clone()
    made[:, 1:] &= agents.visible[:, :-1]
    return made.nonzero(as_tuple=True)


def test_with_all_moves_to_choose_from_a_batch_written_exactly_is_unchanged(
    variant, new_network, logged
):
    network = new_network(variant)

    same = close_loop(network, logged, NUM_MOVES)

    for (name, one), (_, two) in zip(tensors(logged), tensors(same), strict=True):
        assert torch.equal(one, two), name


def test_with_all_moves_to_choose_from_agents_follow_the_log(
    network, blurred, vocabularies
):
    table = make_match_table(vocabularies()[0])
    agents, truth = close_loop(network, blurred, 10_000).agents, blurred.agents
    agent_type = truth.agent_type.numpy().astype(np.int8).ravel()

    pose = truth.pose[:, 0].numpy().reshape(-1, 3)
    for token in range(1, truth.pose.shape[1]):
        target = truth.pose[:, token].numpy().reshape(-1, 3)
        led, pose = follow(target, pose, agent_type, table)
        made = truth.observed[:, token] & truth.visible[:, token - 1]
        made = made.numpy().ravel()
        np.testing.assert_array_equal(
            agents.motion_token[:, token].numpy().ravel()[made], led[made]
        )
        found = agents.pose[:, token].numpy().reshape(-1, 3)
        np.testing.assert_allclose(found[made], pose[made], atol=1e-4)
        pose = np.where(made[:, None], pose, target)
    assert torch.equal(agents.label, agents.motion_token)


@pytest.mark.parametrize("top", [1, 3])
def test_each_move_is_the_nearest_of_the_networks_most_likely(
    network, logged, vocabularies, top
):
    played = close_loop(network, logged, top)
    scene, token, row = moves_made(played)
    vocabulary = vocabularies()[0]
    with torch.no_grad():
        motion = network(played).motion
    logits = motion.rows.spread(motion.motion_logits)[scene, token - 1, row]
    likely = logits.topk(top).indices.numpy()
    agent_type = played.agents.agent_type[scene, row].numpy().astype(np.int8)
    before = played.agents.pose[scene, token - 1, row].numpy()
    truth = logged.agents.pose[scene, token, row].numpy()

    found = played.agents.motion_token[scene, token, row].numpy()

    for at, choice in enumerate(likely):
        few = replace(
            vocabulary,
            path=vocabulary.path[:, np.sort(choice)],
            real=vocabulary.real[:, choice],
        )
        one = slice(at, at + 1)
        best = nearest_motion_tokens(
            truth[one], before[one], agent_type[one], make_match_table(few)
        )
        assert found[at] == np.sort(choice)[best[0]]


def test_poses_follow_moves_and_labels_lead_back_to_the_log(logged, played, vocabularies):
    vocabulary = vocabularies()[0]
    scene, token, row = moves_made(played)
    agents = played.agents
    agent_type = agents.agent_type[scene, row].numpy().astype(np.int8)
    before = agents.pose[scene, token - 1, row].numpy()
    truth = logged.agents.pose[scene, token, row].numpy()

    def end(motion_token):
        return advance(
            before, agent_type, motion_token.numpy().astype(np.int16), vocabulary
        )

    motion_token, label = (
        agents.motion_token[scene, token, row],
        agents.label[scene, token, row],
    )
    np.testing.assert_allclose(agents.pose[scene, token, row], end(motion_token), atol=1e-4)
    best = nearest_motion_tokens(truth, before, agent_type, make_match_table(vocabulary))
    np.testing.assert_array_equal(label, best)
    away_m = np.linalg.norm((end(motion_token) - truth)[:, :2], axis=1)
    after_m = np.linalg.norm((end(label) - truth)[:, :2], axis=1)
    assert after_m.mean() < away_m.mean()
    assert (motion_token != label).any()


def test_agents_may_come_back_only_a_part_of_the_way(logged, network, vocabularies):
    vocabulary, part = vocabularies()[0], Recovery(along=0.0, lateral=0.2)
    whole, played = close_loop(network, logged, 3), close_loop(network, logged, 3, part)
    agents, log = played.agents, logged.agents
    scene, token, row = moves_made(played)
    was_seen = log.observed[scene, token - 1, row]
    scene, token, row = scene[was_seen], token[was_seen], row[was_seen]
    agent_type = agents.agent_type[scene, row].numpy().astype(np.int8)
    before = agents.pose[scene, token - 1, row]
    was, truth = log.pose[scene, token - 1, row], log.pose[scene, token, row]

    wanted = part.target(before, was, truth).numpy()

    best = nearest_motion_tokens(
        wanted, before.numpy(), agent_type, make_match_table(vocabulary)
    )
    label = agents.label[scene, token, row].numpy()
    assert (label == best).mean() > 0.99  # Rounding decides between equally near ones.
    assert not torch.equal(agents.motion_token, whole.agents.motion_token)


def away_m(played, logged):
    """How far agents are from their log, on average."""
    seen = logged.agents.observed & logged.agents.visible
    gap_m = (played.agents.pose - logged.agents.pose)[..., :2].norm(dim=-1)
    return float(gap_m[seen].mean())


def test_the_less_is_made_good_the_farther_agents_are_from_the_log(logged, network):
    whole = close_loop(network, logged, 3)
    part = close_loop(network, logged, 3, Recovery(along=0.2, lateral=0.2))
    assert away_m(part, logged) > away_m(whole, logged) > 0


def test_who_comes_goes_and_is_not_seen_is_the_logs(logged, played):
    changed = {
        name
        for (name, one), (_, two) in zip(tensors(logged), tensors(played), strict=True)
        if not torch.equal(one, two)
    }
    assert {"Agents.pose", "Agents.motion_token", "Agents.label", "Agents.cell"} <= changed
    assert changed <= {
        "Agents.pose",
        "Agents.motion_token",
        "Agents.label",
        "Agents.cell",
        "Insertions.cell",
        "Details.cell",
        "Details.heading",
        "Details.offset_m",
        "Details.offset",
    }
    still = ~logged.agents.observed
    for name in ("pose", "motion_token", "label"):
        one, two = getattr(logged.agents, name), getattr(played.agents, name)
        assert torch.equal(one[still], two[still]), name


def test_who_was_not_seen_goes_on_from_the_log(logged, played):
    agents = logged.agents
    back = agents.observed.clone()
    back[:, 1:] &= ~agents.visible[:, :-1]

    assert back.any()
    assert torch.equal(agents.pose[back], played.agents.pose[back])
    assert torch.equal(agents.motion_token[back], played.agents.motion_token[back])


def test_cells_are_those_of_the_played_ego(logged, played, grid_settings):
    agents, entries, grid = played.agents, played.entries, make_grid(grid_settings)
    assert not torch.equal(agents.pose[:, :, 0], logged.agents.pose[:, :, 0])
    in_grid_m = to_grid(agents.pose[..., :2].numpy(), agents.pose[:, :, :1].numpy())
    cell = torch.from_numpy(encode_cell(in_grid_m, grid)).long()

    assert torch.equal(agents.cell[agents.observed], cell[agents.observed])
    coming = (agents.turn >= 0) & (agents.turn < OUTSIDE)
    assert (agents.cell[coming] != NO_CELL).all()
    inside = coming & (cell != NO_CELL)
    assert torch.equal(agents.cell[inside], cell[inside])
    scene, token, slot = (entries.agent >= 0).nonzero(as_tuple=True)
    row = entries.agent[scene, token, slot]
    assert torch.equal(entries.cell[scene, token, slot], agents.cell[scene, token, row])


def test_details_decode_to_where_agents_are_played(logged, played, grid_settings):
    details, agents, grid = played.details, played.agents, make_grid(grid_settings)
    assert not torch.equal(details.offset_m, logged.details.offset_m)
    scene, row = details.present.nonzero(as_tuple=True)
    token, agent = details.token[scene, row], details.agent[scene, row]
    pose = agents.pose[scene, token, agent].numpy()
    ego_pose = agents.pose[scene, token, 0].numpy()

    centre_m = decode_cell(details.cell[scene, row].numpy().astype(np.int16), grid)
    xy_m = from_grid(centre_m + details.offset_m[scene, row].numpy(), ego_pose)
    turned_rad = grid.heading_centre_rad[details.heading[scene, row]] + ego_pose[:, 2]

    np.testing.assert_allclose(xy_m, pose[:, :2], atol=1e-3)
    missed_rad = (turned_rad - pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(missed_rad).max() < np.radians(5.001)


@pytest.mark.parametrize("training", [True, False])
def test_the_network_is_left_as_it_was_and_nothing_has_a_gradient(
    new_network, logged, training
):
    network = new_network().train(training)
    before = [parameter.clone() for parameter in network.parameters()]

    played = close_loop(network, logged, 3)

    assert network.training == training
    assert all(module.training == training for module in network.modules())
    pairs = zip(network.parameters(), before, strict=True)
    assert all(torch.equal(one, two) for one, two in pairs)
    assert not any(tensor.requires_grad for _, tensor in tensors(played))


def test_a_network_that_fails_is_left_in_its_mode_too(new_network, logged):
    network, agents = new_network().train(), logged.agents
    unheard_of = replace(logged, agents=replace(agents, agent_type=agents.agent_type + 99))

    with pytest.raises(IndexError):
        close_loop(network, unheard_of, 3)

    assert network.training


def test_there_must_be_something_to_choose_from(network, logged):
    with pytest.raises(ValueError, match="0 most likely moves"):
        close_loop(network, logged, 0)


def test_equal_networks_play_equally_also_while_training(tiny, new_network, logged):
    # Dropout would make each play another.
    network = new_network(replace(tiny, dropout=0.5)).train()

    one, two = close_loop(network, logged, 3), close_loop(network, logged, 3)

    pairs = zip(tensors(one), tensors(two), strict=True)
    assert all(torch.equal(a, b) for (_, a), (_, b) in pairs)


def test_the_batch_that_is_played_is_not_changed(network, logged):
    before = [tensor.clone() for _, tensor in tensors(logged)]

    close_loop(network, logged, 2)

    pairs = zip(tensors(logged), before, strict=True)
    assert all(torch.equal(now, then) for (_, now), then in pairs)


def test_what_was_played_can_be_learned_from(variant, new_network, logged):
    network = new_network(variant)
    settings = TrainSettings(label_smoothing=0.0)

    played = close_loop(network, logged, 3)
    loss = total(losses(network(played), played, settings), settings)
    loss.backward()

    gradients = [p.grad for p in network.motion.parameters() if p.grad is not None]
    assert torch.isfinite(loss)
    assert max(float(g.abs().max()) for g in gradients) > 0
