"""Baselines and ablations: what each has and lacks, and that each of them can learn."""

import math
from dataclasses import fields, replace

import pytest
import torch

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.batching.supervision import pattern_mask
from infgen.model.neighbours import cell_pose, grid_place
from infgen.model.network import Network
from infgen.model.training.losses import figures, losses, total
from infgen.tokens.scene_tokens import Presence

TRAIN = TrainSettings(label_smoothing=0.0)
ALWAYS = {"motion", "map"}
CONTROL = {"add", "agent_type", "size"}


@pytest.fixture(scope="module")
def batch(record, limits):
    # Close together: the queries for headings have neighbours.
    scenes = [record(3, agents=12, tokens=9, spread_m=15.0), record(4, agents=6)]
    return collate(scenes, limits, 0)


def terms_of(network, batch):
    return losses(network(batch, hidden_roads=True), batch, TRAIN)


@pytest.mark.parametrize(
    ("switches", "names"),
    [
        ({}, CONTROL | {"keep", "position", "heading", "offset"}),
        ({"insertion_and_removal": False}, set()),
        ({"remove_token": False}, CONTROL | {"position", "heading", "offset"}),
        ({"position_token": False}, CONTROL | {"keep", "position_regression", "heading"}),
        (
            {"heading_token": False},
            CONTROL | {"keep", "position", "heading_regression", "offset"},
        ),
        (
            {"insertion_and_removal": False, "validity_pattern_tokens": True},
            {"validity_pattern"},
        ),
    ],
)
def test_each_variant_has_the_terms_of_its_heads(tiny, new_network, batch, switches, names):
    terms = terms_of(new_network(replace(tiny, **switches)), batch)

    assert terms.keys() == ALWAYS | names
    assert all(float(term.count) > 0 for term in terms.values())
    assert all(f"{name}_weight" in {f.name for f in fields(TRAIN)} for name in terms)


def test_a_step_of_training_moves_every_parameter(variant, new_network, batch):
    network = new_network(variant)
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)

    loss = total(terms_of(network, batch), TRAIN)
    loss.backward()
    optimiser.step()

    assert math.isfinite(float(loss.detach()))
    for name, parameter in network.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any() or _has_no_say(name), name
        assert not torch.equal(parameter, before[name]) or _has_no_say(name), name


def _has_no_say(name):
    """Words that no agent of these scenes has."""
    return "special_moves" in name or "no_cell" in name


def test_figures_call_no_distance_right_or_wrong(tiny, new_network, batch):
    settings = replace(tiny, position_token=False, heading_token=False)

    found = figures(terms_of(new_network(settings), batch))

    assert {
        "position_regression",
        "heading_regression",
        "position_regression_count",
    } <= found.keys()
    assert (
        not {"position_regression_accuracy", "heading_regression_accuracy", "size_accuracy"}
        & found.keys()
    )


def test_heads_that_are_off_leave_the_others_weights_as_they_were(vocabularies, tiny):
    def weights(**switches):
        torch.manual_seed(0)
        grid = TokenSettings(grid_radius_m=60.0, grid_cell_m=4.0)
        network = Network(replace(tiny, **switches), *vocabularies(), grid)
        return dict(network.named_parameters())

    full, smart = weights(), weights(insertion_and_removal=False)
    extra = full.keys() - smart.keys()

    assert smart.keys() < full.keys()
    assert {name.split(".")[0] for name in extra} == {
        "cells",
        "details",
        "embed",
        "motion",
    }
    assert weights(validity_pattern_tokens=True).keys() > full.keys()


def test_smart_has_about_seven_million_parameters(vocabularies):
    settings = ModelSettings(insertion_and_removal=False, temporal_window_tokens=6)
    network = Network(settings, *vocabularies(2048, 1024), TokenSettings())

    assert 6.8e6 < sum(p.numel() for p in network.parameters()) < 7.4e6


def test_who_enters_where_changes_nothing_where_only_motion_is_modelled(
    tiny, new_network, batch
):
    network = new_network(replace(tiny, insertion_and_removal=False)).eval()
    agents = batch.agents
    leaving = agents.presence == Presence.REMOVED
    presence = agents.presence.masked_fill(leaving, int(Presence.PRESENT))
    other = replace(agents, presence=presence, cell=agents.cell * 0)

    with torch.no_grad():
        one, two = network(batch), network(replace(batch, agents=other))

    assert leaving.any()
    assert torch.equal(one.motion.motion_logits, two.motion.motion_logits)


def test_places_are_the_inverse_of_cells(batch):
    ego_pose = torch.tensor([[3.0, -2.0, 0.7], [0.0, 5.0, -2.0]])
    position_m = torch.tensor([[10.0, -20.0], [0.5, 40.0]])

    there = cell_pose(ego_pose, position_m)

    torch.testing.assert_close(grid_place(there, ego_pose), position_m, atol=1e-4, rtol=0)


def test_regression_of_places_and_headings_is_right_at_the_logs_own(
    tiny, new_network, batch
):
    network = new_network(replace(tiny, position_token=False, heading_token=False))
    outputs = network(batch, hidden_roads=True)
    entries, details, pose = batch.entries, batch.details, batch.agents.pose

    position_m = torch.zeros_like(outputs.entries.position_m)
    for row, at in enumerate(outputs.entries.rows.at.tolist()):
        scene, token = divmod(at, entries.agent.shape[1])
        for slot, agent in enumerate(entries.agent[scene, token].tolist()):
            ego_pose = pose[scene, token, 0]
            position_m[row, slot] = grid_place(pose[scene, token, agent], ego_pose)
    turned_rad = torch.zeros_like(outputs.details.turned_rad)
    for row, at in enumerate(outputs.details.rows.at.tolist()):
        scene, one = divmod(at, details.agent.shape[1])
        token, agent = details.token[scene, one], details.agent[scene, one]
        away_rad = pose[scene, token, agent, 2] - pose[scene, token, 0, 2]
        turned_rad[row] = away_rad + 2 * math.pi  # A whole turn more is no error.
    right = replace(
        outputs,
        entries=replace(outputs.entries, position_m=position_m + 6.0),
        details=replace(outputs.details, turned_rad=turned_rad + 0.3),
    )
    terms = losses(right, batch, TRAIN)

    # Six metres off in a grid of sixty, and 0.3 of a half turn of pi.
    assert float(terms["position_regression"].mean) == pytest.approx(0.1**2, rel=1e-3)
    assert float(terms["heading_regression"].mean) == pytest.approx(
        (0.3 / math.pi) ** 2, rel=1e-3
    )


def test_regressed_places_stay_within_the_grids_square(tiny, new_network, batch):
    outputs = new_network(replace(tiny, position_token=False))(batch)

    assert outputs.entries.position_logits is None
    assert outputs.details.offset_m is None
    assert outputs.entries.position_m.abs().max() <= 60.0


def test_patterns_are_learned_as_long_as_an_agent_lives_on(batch, tiny, new_network):
    agents = batch.agents
    mask = pattern_mask(agents)
    following = torch.roll(agents.presence, -1, dims=1)[:, :-1]

    lives_on = (following == Presence.PRESENT) | (following == Presence.REMOVED)
    assert torch.equal(mask[:, :-1], agents.visible[:, :-1] & lives_on)
    assert not mask[:, -1].any()
    assert mask[:, :-1, 0].any()

    network = new_network(replace(tiny, validity_pattern_tokens=True))
    outputs = network(batch, hidden_roads=True)
    target = torch.roll(agents.pattern, -1, dims=1)
    sure = torch.nn.functional.one_hot(outputs.motion.rows.pack(target), 32) * 50.0
    told = replace(outputs, motion=replace(outputs.motion, pattern_logits=sure))
    term = losses(told, batch, TRAIN)["validity_pattern"]

    assert float(term.mean) < 1e-4
    assert float(term.right) == float(term.count) == float(mask.sum())
