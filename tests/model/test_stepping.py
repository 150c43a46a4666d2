"""Played one column at a time, the network says what it says of all columns at once."""

from dataclasses import replace

import pytest
import torch

from infgen.model.batching.batch import collate, collate_maps
from infgen.model.batching.insertion_targets import OUTSIDE
from infgen.model.neighbours import grid_place
from infgen.model.stepping import Stepper
from infgen.model.token_step import TokenStep
from infgen.tokens.scene_tokens import NO_CELL, NO_MOTION_TOKEN, Presence

CLOSE = {"atol": 1e-4, "rtol": 1e-4}


def column_at(agents, token, turns=OUTSIDE + 1):
    """Token step of a batch with the agents inserted up to a turn."""
    hidden = agents.turn[:, token] >= turns
    presence = agents.presence[:, token].masked_fill(hidden, int(Presence.ABSENT))
    return TokenStep(
        agent_type=agents.agent_type,
        size_lwh_m=agents.size_lwh_m,
        pose=agents.pose[:, token],
        motion_token=agents.motion_token[:, token].masked_fill(hidden, NO_MOTION_TOKEN),
        presence=presence,
        observed=agents.observed[:, token] & ~hidden,
        cell=agents.cell[:, token].masked_fill(hidden, NO_CELL),
    )


def places(batch, token, slot):
    """Position of the inserted agent of a slot in the ego's grid frame."""
    pose = batch.agents.pose[:, token]
    agent = batch.entries.agent[:, token, slot].clamp(min=0)
    return grid_place(pose[torch.arange(len(agent)), agent], pose[:, 0])


def same(step, wanted):
    """Both say nothing, or both the same."""
    assert (step is None) == (wanted is None)
    if step is not None:
        torch.testing.assert_close(step, wanted, **CLOSE)


def of(values, *index):
    return None if values is None else values[index]


def play(network, batch, records):
    """Teacher-forced logits: motion per token, entries per (token, turn)."""
    stepper = Stepper(network)
    scenes = len(records)
    rows = batch.agents.agent_type.shape[1]
    maps = replace(collate_maps(records, 10_000), shown=batch.roads.shown)
    memory = stepper.begin(maps, torch.arange(scenes), rows)
    motion, queries, details = [], {}, {}
    slots, by_cell = batch.entries.agent.shape[2], network.settings.position_token
    for token in range(batch.agents.pose.shape[1]):
        if token > 0 and stepper.insertion_and_removal:
            entries = stepper.entry_begin(memory, column_at(batch.agents, token, turns=0))
            for slot in range(slots):
                queries[token, slot] = stepper.entry_query(entries)
                cell = batch.entries.cell[:, token, slot]
                position_m = None if by_cell else places(batch, token, slot)
                details[token, slot] = stepper.entry_details(entries, cell, position_m)
                token_step = column_at(batch.agents, token, turns=slot + 1)
                entries = stepper.entry_add(entries, token_step)
        motion.append(stepper.motion_step(memory, column_at(batch.agents, token)))
    return motion, queries, details


@pytest.fixture(scope="module")
def records(record):
    # Fourteen columns: three times the window of past columns; entries, exits, padding.
    return [record(3, agents=12, tokens=14), record(4, agents=6, tokens=9, roads=31)]


@pytest.fixture(scope="module")
def both(variant, new_network, records, limits):
    network = new_network(variant).eval()
    batch = collate(records, limits, draw=0)
    with torch.no_grad():
        outputs = network(batch)
    return batch, outputs, play(network, batch, records)


def test_motion_is_the_same_step_by_step(both):
    batch, outputs, (motion, _, _) = both
    for name in ("motion_logits", "remove_logit", "pattern_logits"):
        said = getattr(outputs.motion, name)
        spread = None if said is None else outputs.motion.rows.spread(said)
        for token, step in enumerate(motion):
            seen = batch.agents.visible[:, token]
            wanted = None if spread is None else spread[:, token][seen]
            same(of(getattr(step, name), seen), wanted)


def test_queries_for_newcomers_are_the_same_step_by_step(both):
    batch, outputs, (_, queries, _) = both
    said = outputs.entries
    assert (said is None) == (not queries)
    assert (batch.entries.agent >= 0).sum() >= 3
    for (token, slot), query in queries.items():
        seen = batch.entries.asked[:, token]
        for name in ("add_logit", "position_logits", "position_m"):
            wanted = getattr(said, name)
            wanted = None if wanted is None else said.rows.spread(wanted)
            same(of(getattr(query, name), seen), of(wanted, seen, token, slot))


def test_details_of_newcomers_are_the_same_step_by_step(both):
    batch, outputs, (_, _, details) = both
    found, wanted = outputs.details, batch.details
    if found is None:
        return
    pack = found.rows.pack
    scene = found.rows.at // wanted.present.shape[1]
    compared = 0
    for row in pack(wanted.inserted).nonzero()[:, 0].tolist():
        token, turn = int(pack(wanted.token)[row]), int(pack(wanted.turn)[row])
        step, agent_type = details[token, turn], int(pack(wanted.agent_type)[row])
        at = scene[row]
        same(step.agent_type_logits[at], found.agent_type_logits[row])
        same(step.size_lwh_m[at, agent_type].log(), found.size_log_m[row])
        for name in ("heading_logits", "turned_rad", "offset_m"):
            if name == "heading_logits" and step.query is not None:
                continue  # Given the offset: below.
            same(of(getattr(step, name), at, agent_type), of(getattr(found, name), row))
        assert (step.query is None) == (found.offset_logits is None)
        if step.query is not None:
            each = torch.ones(len(step.agent_type_logits), dtype=torch.int64)
            offset = int(pack(wanted.offset)[row])
            said = step.query.offset_logits(agent_type * each)
            same(said[at], found.offset_logits[row])
            said = step.query.heading_logits(agent_type * each, offset * each)
            same(said[at], found.heading_logits[row])
        compared += 1
    assert compared >= 3


def test_weights_that_know_motion_only_let_nobody_in(tiny, new_network, records):
    stepper = Stepper(new_network(replace(tiny, insertion_and_removal=False)))
    roads = collate_maps(records, 10_000)
    memory = stepper.begin(roads, torch.arange(2), rows=4)
    nobody = TokenStep(
        agent_type=torch.zeros((2, 4), dtype=torch.int64),
        size_lwh_m=torch.ones((2, 4, 3)),
        pose=torch.zeros((2, 4, 3)),
        motion_token=torch.full((2, 4), NO_MOTION_TOKEN),
        presence=torch.zeros((2, 4), dtype=torch.int64),
        observed=torch.zeros((2, 4), dtype=torch.bool),
        cell=torch.full((2, 4), NO_CELL),
    )

    with pytest.raises(ValueError, match="motion only"):
        stepper.entry_begin(memory, nobody)
