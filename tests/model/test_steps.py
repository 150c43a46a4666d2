"""Played one column at a time, the network says what it says of all columns at once."""

import pytest
import torch

from infgen.model.batch import OUTSIDE, collate, collate_roads
from infgen.model.steps import Column, Stepper
from infgen.tokens.scene_tokens import NO_CELL, NO_MOVE, Presence

CLOSE = {"atol": 1e-4, "rtol": 1e-4}


def column_at(agents, token, turns=OUTSIDE + 1):
    """Column of a batch with newcomers up to a turn; the others are not there yet."""
    hidden = agents.turn[:, token] >= turns
    presence = agents.presence[:, token].masked_fill(hidden, int(Presence.ABSENT))
    return Column(
        kind=agents.kind,
        size_lwh_m=agents.size_lwh_m,
        pose=agents.pose[:, token],
        move=agents.move[:, token].masked_fill(hidden, NO_MOVE),
        presence=presence,
        observed=agents.observed[:, token] & ~hidden,
        cell=agents.cell[:, token].masked_fill(hidden, NO_CELL),
    )


def play(network, batch, records):
    """Teacher-forced logits: motion per token, entries per (token, turn)."""
    stepper = Stepper(network)
    scenes = len(records)
    rows = batch.agents.kind.shape[1]
    memory = stepper.begin(collate_roads(records, 10_000), torch.arange(scenes), rows)
    motion, queries, details = [], {}, {}
    slots = batch.entries.agent.shape[2]
    for token in range(batch.agents.pose.shape[1]):
        if token > 0:
            entries = stepper.entry_begin(memory, column_at(batch.agents, token, turns=0))
            for slot in range(slots):
                queries[token, slot] = stepper.entry_query(entries)
                cell = batch.entries.cell[:, token, slot]
                details[token, slot] = stepper.entry_details(entries, cell)
                column = column_at(batch.agents, token, turns=slot + 1)
                entries = stepper.entry_add(entries, column)
        motion.append(stepper.motion_step(memory, column_at(batch.agents, token)))
    return motion, queries, details


@pytest.fixture(scope="module")
def records(record):
    # Fourteen columns: three times the window of past columns; entries, exits, padding.
    return [record(3, agents=12, tokens=14), record(4, agents=6, tokens=9, roads=31)]


@pytest.fixture(scope="module")
def both(network, records, limits):
    batch = collate(records, limits, draw=0)
    with torch.no_grad():
        outputs = network(batch)
    return batch, outputs, play(network, batch, records)


def test_motion_is_the_same_step_by_step(both):
    batch, outputs, (motion, _, _) = both
    visible = batch.agents.visible

    moves = outputs.motion.rows.spread(outputs.motion.move_logits)
    leave = outputs.motion.rows.spread(outputs.motion.leave_logit)

    for token, step in enumerate(motion):
        seen = visible[:, token]
        torch.testing.assert_close(step.move_logits[seen], moves[:, token][seen], **CLOSE)
        torch.testing.assert_close(step.leave_logit[seen], leave[:, token][seen], **CLOSE)


def test_queries_for_newcomers_are_the_same_step_by_step(both):
    batch, outputs, (_, queries, _) = both
    asked = batch.entries.asked
    add = outputs.entries.rows.spread(outputs.entries.add_logit)
    cells = outputs.entries.rows.spread(outputs.entries.cell_logits)
    assert (batch.entries.agent >= 0).sum() >= 3

    for (token, slot), query in queries.items():
        seen = asked[:, token]
        torch.testing.assert_close(query.add_logit[seen], add[seen, token, slot], **CLOSE)
        torch.testing.assert_close(
            query.cell_logits[seen], cells[seen, token, slot], **CLOSE
        )


def test_details_of_newcomers_are_the_same_step_by_step(both):
    batch, outputs, (_, _, details) = both
    found, wanted = outputs.details, batch.details
    pack = found.rows.pack
    scene = found.rows.at // wanted.present.shape[1]
    compared = 0
    for row in pack(wanted.newcomer).nonzero()[:, 0].tolist():
        token, turn = int(pack(wanted.token)[row]), int(pack(wanted.turn)[row])
        step, kind = details[token, turn], int(pack(wanted.kind)[row])
        at = scene[row]
        torch.testing.assert_close(step.kind_logits[at], found.kind_logits[row], **CLOSE)
        size = step.size_lwh_m[at, kind].log()
        torch.testing.assert_close(size, found.size_log_m[row], **CLOSE)
        heading = step.heading_logits[at, kind]
        torch.testing.assert_close(heading, found.heading_logits[row], **CLOSE)
        torch.testing.assert_close(step.offset_m[at, kind], found.offset_m[row], **CLOSE)
        compared += 1
    assert compared >= 3
