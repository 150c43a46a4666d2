"""Choices that put an inserted agent onto another one."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import TrainSettings
from infgen.geometry import boxes_overlap
from infgen.model.batching.batch import collate
from infgen.model.insertion.agent_spacing import MAX_SWEPT_M
from infgen.model.training.policy_gradient.avoided.insertion_overlaps import (
    InsertionOverlaps,
    find_insertion_overlaps,
)
from infgen.model.training.policy_gradient.lessons import figures, simulate_lessons
from infgen.model.training.policy_gradient.rollouts import simulate_rollouts
from infgen.model.training.policy_gradient.terms import LEAST_ODDS, policy_terms
from infgen.scene import AgentType
from infgen.tokens.grid import from_grid
from infgen.tokens.scene_tokens import Presence

HOW = TrainSettings(policy_gradient_rollouts=3, insertion_overlap_penalty=1.0)


@pytest.fixture(scope="module")
def network(tiny, new_network):
    """Whose positions, headings and offsets are all tokens."""
    return new_network(replace(tiny, offset_token=True)).eval()


@pytest.fixture(scope="module")
def logged(record, limits):
    return collate([record(3, tokens=9, spread_m=12.0), record(4, tokens=9)], limits, 7)


@pytest.fixture(scope="module")
def rollouts(network, logged):
    """Of agents five times as long and wide as they were, so that many overlap."""
    found = simulate_rollouts(network, logged, 3, 0.9, 5)
    agents = found.batch.agents
    agents = replace(agents, size_lwh_m=5 * agents.size_lwh_m)
    return replace(found, batch=replace(found.batch, agents=agents))


def overlaps_alone(network, logged, rollouts):
    """The first rollout, in which nothing else is to be learned."""
    lesson = simulate_lessons(network, logged, HOW, 5).lessons[0]
    overlaps = find_insertion_overlaps(rollouts, network.grid).only(rollouts.rows(0))
    assert torch.equal(overlaps.at, lesson.insertion_overlaps.at)
    names = ("advantage", "type_advantage", "count_advantage")
    nothing = {x: torch.zeros_like(getattr(lesson, x)) for x in names}
    return replace(lesson, insertion_overlaps=overlaps, **nothing)


def insertions(rollouts):
    """Rollout and place among the details of all inserted agents, in order."""
    return rollouts.batch.details.present.nonzero().tolist()


def rows_of_others(rollouts, rollout, place):
    """Rows of those that an agent may overlap when it is inserted."""
    details, agents = rollouts.batch.details, rollouts.batch.agents
    token, own = (int(x[rollout, place]) for x in (details.token, details.agent))
    for row in range(agents.pose.shape[2]):
        walks = {int(agents.agent_type[rollout, x]) for x in (own, row)}
        later = rollouts.inserted[rollout, token, row] and (
            agents.turn[rollout, token, row] >= details.turn[rollout, place]
        )
        there = agents.presence[rollout, token, row] != Presence.ABSENT
        if there and not later and walks != {int(AgentType.PEDESTRIAN)}:
            yield row


def swept_box(agents, rollout, token, row):
    """Box that an agent sweeps in a token step, if it moves on."""
    pose = agents.pose[rollout, token, row].numpy().copy()
    size_lw_m = agents.size_lwh_m[rollout, row, :2].numpy().copy()
    fresh = agents.presence[rollout, token, row] == Presence.INSERTED
    if token and agents.visible[rollout, token - 1, row] and not fresh:
        way = np.array([np.cos(pose[2]), np.sin(pose[2])])
        step_m = pose[:2] - agents.pose[rollout, token - 1, row, :2].numpy()
        ahead_m = min(max(step_m @ way, 0), MAX_SWEPT_M)
        pose[:2] += ahead_m / 2 * way
        size_lw_m[0] += ahead_m
    return pose, size_lw_m


def overlaps(rollouts, rollout, place, offset_m, heading_rad):
    """Whether a box there, from the centre of the grid and the ego's heading, overlaps."""
    details, agents = rollouts.batch.details, rollouts.batch.agents
    token, own = (int(x[rollout, place]) for x in (details.token, details.agent))
    pose = agents.pose[rollout, token].numpy()
    size_lw_m = agents.size_lwh_m[rollout, :, :2].numpy()
    xy_m = from_grid(np.asarray(offset_m, np.float32), pose[0])
    box = np.array([*xy_m, pose[0, 2] + heading_rad], dtype=np.float32)
    rows = rows_of_others(rollouts, rollout, place)
    others = [swept_box(agents, rollout, token, row) for row in rows]
    hits = boxes_overlap(
        box[None], size_lw_m[None, own], *map(np.stack, zip(*others, strict=True))
    )
    return bool(hits.any())


def test_choices_overlap_where_boxes_do(network, rollouts):
    grid, details = network.grid, rollouts.batch.details
    random = np.random.default_rng(0)

    found = find_insertion_overlaps(rollouts, grid)

    assert found.at.tolist() == insertions(rollouts)
    counted = [0, 0, 0]
    for number, (rollout, place) in enumerate(found.at.tolist()):
        cell, offset, heading = (
            int(x[rollout, place]) for x in (details.cell, details.offset, details.heading)
        )
        own = cell, offset, heading
        for kind, marked in enumerate((found.cell, found.offset, found.heading)):
            some = marked[number].nonzero()[:, 0].tolist()[:3]
            for each in {*some, *random.integers(marked.shape[1], size=4).tolist()}:
                tried = [*own[:kind], each, *own[kind + 1 :]]
                position_m = grid.centre_m[tried[0]] + grid.offset_m[tried[1]]
                expected = overlaps(
                    rollouts, rollout, place, position_m, grid.heading_centre_rad[tried[2]]
                )
                assert marked[number, each] == expected
                counted[kind] += expected
    assert min(counted) > 0


def test_own_choices_are_counted(network, rollouts):
    details = rollouts.batch.details

    found = find_insertion_overlaps(rollouts, network.grid)

    rollout, place = found.at.T
    each = torch.arange(len(found.at))
    taken = found.cell[each, details.cell[rollout, place]]
    for marked, chosen in (
        (found.offset, details.offset),
        (found.heading, details.heading),
    ):
        assert torch.equal(marked[each, chosen[rollout, place]], taken)
    assert found.taken == int(taken.sum()) > 0


def test_those_of_some_rollouts_are_numbered_from_the_first(network, rollouts):
    found = find_insertion_overlaps(rollouts, network.grid)

    some = found.only(slice(2, 4))

    asked = (found.at[:, 0] == 2) | (found.at[:, 0] == 3)
    assert torch.equal(some.at[:, 0], found.at[asked, 0] - 2)
    assert torch.equal(some.cell, found.cell[asked])
    assert torch.equal(some.heading, found.heading[asked])
    assert int(found.at[:, 0].max()) > 1


def test_cells_near_to_the_sampled_one_are_those_within_twelve_metres(network, rollouts):
    centre_m = torch.from_numpy(network.grid.centre_m)

    found = find_insertion_overlaps(rollouts, network.grid)

    rollout, place = found.at.T
    sampled_m = centre_m[rollouts.batch.details.cell[rollout, place]]
    assert torch.equal(found.near, torch.cdist(sampled_m, centre_m) <= 12.0)


def test_cells_far_from_the_sampled_one_are_left_as_they_are(network, logged, rollouts):
    lesson = overlaps_alone(network, logged, rollouts)
    overlaps, details = lesson.insertion_overlaps, lesson.batch.details
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    outputs, pretrained = network(lesson.batch), network(lesson.batch)
    outputs.entries.position_logits.retain_grad()

    policy_terms(outputs, pretrained, lesson, stationary, HOW)["policy"].loss.backward()

    scene, place = overlaps.at.T
    row = outputs.entries.rows.number[scene, details.token[scene, place]]
    found = outputs.entries.position_logits.grad[row, details.turn[scene, place]]
    assert found[overlaps.near].any()
    assert not found[~overlaps.near].any()


def test_there_may_be_no_insertion(network, rollouts):
    details = rollouts.batch.details
    nothing = replace(details, present=torch.zeros_like(details.present))
    none = replace(rollouts, batch=replace(rollouts.batch, details=nothing))

    found = find_insertion_overlaps(none, network.grid)

    expected = InsertionOverlaps.none(network.grid, details.present.device)
    assert found.cell.shape == expected.cell.shape
    assert found.offset.shape == expected.offset.shape
    assert found.heading.shape == expected.heading.shape
    assert found.taken == 0


def test_lessons_look_at_them_where_they_cost(network, logged):
    many = replace(HOW, policy_gradient_rollouts=12)
    lessons = simulate_lessons(network, logged, many, 5)
    free = simulate_lessons(network, logged, replace(HOW, insertion_overlap_penalty=0), 5)

    assert sum(len(each.insertion_overlaps.at) for each in lessons.lessons) > 0
    assert figures(lessons.sums)["rollout_insertion_overlap"] > 0
    assert not any(len(each.insertion_overlaps.at) for each in free.lessons)
    assert figures(free.sums)["rollout_insertion_overlap"] == 0


def test_places_on_others_become_less_likely(network, logged, rollouts):
    lesson = overlaps_alone(network, logged, rollouts)
    overlaps = lesson.insertion_overlaps
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)

    def loss(asked):
        outputs = asked(lesson.batch)
        terms = policy_terms(outputs, network(lesson.batch), lesson, stationary, HOW)
        return terms["policy"].loss

    def avoided(asked):
        """Probability of the choices that overlap, of each kind of choice."""
        outputs, (scene, place) = asked(lesson.batch), overlaps.at.T
        details = outputs.details.rows.number[scene, place]
        at = (
            lesson.batch.details.token[scene, place],
            lesson.batch.details.turn[scene, place],
        )
        row = outputs.entries.rows.number[scene, at[0]]
        cells = outputs.entries.position_logits[row, at[1]]
        return [
            (logits.double().softmax(dim=-1) * marked).sum(dim=-1)
            for logits, marked in (
                (cells.masked_fill(~overlaps.near, -torch.inf), overlaps.cell),
                (outputs.details.offset_logits[details], overlaps.offset),
                (outputs.details.heading_logits[details], overlaps.heading),
            )
        ]

    student = copy.deepcopy(network)
    before = loss(student)
    before.backward()
    with torch.no_grad():
        for each in student.parameters():
            if each.grad is not None:
                each -= 1e-3 * each.grad

    expected = torch.zeros(())
    for likely in avoided(network):
        odds = 1 - (1 - LEAST_ODDS) * likely
        left = likely * LEAST_ODDS / odds
        expected += (left * math.log(LEAST_ODDS) - odds.log()).sum()
    torch.testing.assert_close(before, expected, atol=0, rtol=2e-5)  # Sums of float32.
    assert loss(student) < before
    for one, other in zip(avoided(student), avoided(network), strict=True):
        assert one.sum() < other.sum()
