"""What rollouts teach: good choices become likelier, near to the pretrained network."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import logsigmoid

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.choices import choices_made
from infgen.model.training.policy_gradient.divergence import divergence
from infgen.model.training.policy_gradient.lessons import (
    SUMS,
    figures,
    simulate_lessons,
)
from infgen.model.training.policy_gradient.rollouts import HISTORY_TOKENS
from infgen.model.training.policy_gradient.terms import CLIP, LEAST_ODDS, policy_terms
from infgen.tokens.scene_tokens import Presence

HOW = TrainSettings(
    policy_gradient_rollouts=3,
    policy_top_p=0.9,
    conflict_penalty=2.0,
    departure_penalty=2.0,
    creeping_penalty=2.0,
)
ROUNDING = 1e-6
"""Between a network with gradients and its copy without, which sums in another order."""


@pytest.fixture(scope="module")
def logged(record, limits):
    return collate([record(3, tokens=9, spread_m=12.0), record(4, tokens=9)], limits, 7)


@pytest.fixture(scope="module")
def lessons(network, logged):
    return simulate_lessons(network, logged, HOW, 5)


def steepest(part):
    """Largest entry of the gradient of a part."""
    found = [p.grad.abs().max() for p in part.parameters() if p.grad is not None]
    return max(map(float, found), default=0.0)


def likely(logits, chosen):
    """Log-probability of what was chosen, summed."""
    return logits.log_softmax(dim=-1).gather(1, chosen).sum()


def terms(network, pretrained, lesson):
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    with torch.no_grad():
        before = pretrained(lesson.batch)
    return policy_terms(network(lesson.batch), before, lesson, stationary, HOW)


def worthless(lesson):
    """The same lesson, in which no choice is better than another."""
    names = ("advantage", "type_advantage", "count_advantage")
    nothing = {x: torch.zeros_like(getattr(lesson, x)) for x in names}
    none = lesson.conflicts.only(slice(0, 0))
    return replace(lesson, conflicts=none, departures=none, creeping=none, **nothing)


def after_a_step(network, lesson):
    """A copy of the network after a step along the gradient of the policy term."""
    student = copy.deepcopy(network)
    terms(student, network, lesson)["policy"].loss.backward()
    with torch.no_grad():
        for each in student.parameters():
            if each.grad is not None:
                each -= 1e-4 * each.grad
    return student


def test_there_is_a_lesson_for_every_rollout_and_choices_have_advantages(lessons, logged):
    assert len(lessons.lessons) == 3
    for lesson in lessons.lessons:
        assert lesson.moved.shape[0] == len(logged.agents.pose)
        assert lesson.advantage[lesson.moved].abs().max() > 0
    total = torch.stack([each.advantage for each in lessons.lessons])
    moved = torch.stack([each.moved for each in lessons.lessons])
    everywhere = moved.all(dim=0)
    everywhere &= everywhere[:, HISTORY_TOKENS, None]  # Others are not the same agent.
    # What is the mean of the others' to one is the others' mean to the next.
    torch.testing.assert_close(
        total.sum(dim=0)[everywhere],
        torch.zeros(int(everywhere.sum())),
        atol=1e-5,
        rtol=0,
    )


def test_the_divergence_from_itself_is_zero_and_grows_with_the_distance(network, lessons):
    lesson = lessons.lessons[0]
    near, far = copy.deepcopy(network), copy.deepcopy(network)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for one, other in zip(near.parameters(), far.parameters(), strict=True):
            step = torch.randn(one.shape, generator=random)
            one += 0.001 * step
            other += 0.01 * step

    with torch.no_grad():
        found = [
            divergence(each(lesson.batch), network(lesson.batch), lesson)
            for each in (network, near, far)
        ]

    assert found[0] == 0
    assert 0 < found[1] < found[2]


def test_choices_with_a_positive_advantage_become_likelier(network, lessons):
    """A step along the gradient of an advantage of one motion token."""
    lesson = lessons.lessons[0]
    chosen = lesson.moved.nonzero()[10]
    for sign in (1.0, -1.0):
        only = worthless(lesson)
        only.advantage[tuple(chosen)] = sign

        before, after = (
            terms(each, network, only)["policy"].loss
            for each in (network, after_a_step(network, only))
        )

        # The loss is minus the log-probability, times the sign.
        assert after < before


def avoiding(network, lesson, kind):
    """A lesson of one motion token alone, of which the first five are to be avoided."""
    at = lesson.moved.nonzero()[10]
    avoided = torch.zeros((1, network.motion_vocabulary().num_motion_tokens)).bool()
    avoided[0, :5] = True
    return replace(worthless(lesson), **{kind: AvoidedTokens(at[None], avoided, 1)})


def logits_of(motion, tokens):
    scene, token, agent = tokens.at[0].tolist()
    return motion.motion_logits[motion.rows.number[scene, token - 1, agent]]


@pytest.mark.parametrize("kind", ["conflicts", "departures", "creeping"])
def test_motion_tokens_to_be_avoided_become_less_likely(network, lessons, kind):
    lesson = lessons.lessons[0]
    only = avoiding(network, lesson, kind)
    tokens = getattr(only, kind)

    before, after = (
        each(lesson.batch).motion for each in (network, after_a_step(network, only))
    )

    def others(motion):
        return logits_of(motion, tokens).softmax(dim=0)[~tokens.avoided[0]].sum()

    loss = terms(network, network, only)["policy"].loss
    odds = others(before) + LEAST_ODDS * (1 - others(before))
    expected = -odds.log() + (1 - others(before)) * LEAST_ODDS / odds * math.log(LEAST_ODDS)
    torch.testing.assert_close(loss, HOW.conflict_penalty * expected)
    assert others(after) > others(before)


def test_all_others_are_to_be_as_likely_beside_each_other_as_they_were(network, lessons):
    only = avoiding(network, lessons.lessons[0], "conflicts")
    tokens, outputs = only.conflicts, network(only.batch)
    logits = logits_of(outputs.motion, tokens)
    wanted = (logits + tokens.avoided[0] * math.log(LEAST_ODDS)).softmax(dim=0)

    outputs.motion.motion_logits.retain_grad()
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    with torch.no_grad():
        pretrained = network(only.batch)
    policy_terms(outputs, pretrained, only, stationary, HOW)["policy"].loss.backward()

    scene, token, agent = tokens.at[0].tolist()
    row = outputs.motion.rows.number[scene, token - 1, agent]
    found = outputs.motion.motion_logits.grad[row]
    expected = HOW.conflict_penalty * (logits.detach().softmax(dim=0) - wanted.detach())
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-4)


def gradient(network, lesson):
    """Of the policy term, all of it."""
    network.zero_grad()
    loss = terms(network, network, lesson)["policy"].loss
    loss.backward()
    found = [p.grad.flatten() for p in network.parameters() if p.grad is not None]
    network.zero_grad(set_to_none=True)
    return loss.detach(), torch.cat(found)


def test_ratios_have_the_gradient_of_log_probabilities_until_the_weights_change(
    network, lessons
):
    lesson = lessons.lessons[0]
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    with torch.no_grad():
        made = choices_made(network(lesson.batch), lesson, stationary, HOW.policy_top_p)

    loss, noted = gradient(network, replace(lesson, log_probability=made.log_probability))
    other_loss, plain = gradient(network, lesson)

    torch.testing.assert_close(noted, plain, atol=1e-5, rtol=1e-4)
    gained = made.advantage.sum() - (made.advantage * made.log_probability).sum()
    torch.testing.assert_close(other_loss - loss, gained, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("good", [True, False])
@pytest.mark.parametrize("likelier", [True, False])
def test_a_choice_whose_probability_has_changed_enough_teaches_nothing_more(
    network, lessons, good, likelier
):
    only = worthless(lessons.lessons[0])
    chosen = only.moved.nonzero()[10]
    only.advantage[tuple(chosen)] = 1.0 if good else -1.0
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    with torch.no_grad():
        made = choices_made(network(only.batch), only, stationary, HOW.policy_top_p)
    change = math.log(1 + 2 * CLIP) if likelier else math.log(1 - 2 * CLIP)

    _, found = gradient(
        network, replace(only, log_probability=made.log_probability - change)
    )

    assert bool(found.any()) == (good != likelier)


def test_cells_and_headings_of_inserted_agents_are_learned_too(network, lessons):
    found = []
    for lesson in lessons.lessons:
        agents = lesson.batch.entries.agent
        at = (agents >= 0).nonzero()
        advantage = torch.zeros_like(lesson.advantage)
        for scene, token, slot in at.tolist():
            advantage[scene, token, agents[scene, token, slot]] = 1.0
        network.zero_grad()
        only = replace(worthless(lesson), advantage=advantage)
        terms(network, network, only)["policy"].loss.backward()
        found.append([steepest(head) for head in (network.cells, network.details)])
        network.zero_grad(set_to_none=True)

    assert all(value > 0 for value in map(max, zip(*found, strict=True)))


def test_types_of_inserted_agents_are_learned_by_their_own_advantage(network, lessons):
    lesson = next(each for each in lessons.lessons if each.batch.details.present.any())
    only = worthless(lesson)
    only.type_advantage[:] = 1.0

    before, after = (
        each(lesson.batch).details for each in (network, after_a_step(network, only))
    )

    chosen = before.rows.pack(lesson.batch.details.agent_type)[:, None]
    assert likely(after.agent_type_logits, chosen) > likely(
        before.agent_type_logits, chosen
    )


def test_offset_tokens_of_inserted_agents_are_learned_too(new_network, tiny, logged):
    network = new_network(replace(tiny, offset_token=True)).eval()
    lesson = next(
        each
        for each in simulate_lessons(network, logged, HOW, 5).lessons
        if each.batch.details.present.any()
    )
    only = worthless(lesson)
    only.advantage[:] = 1.0

    after = after_a_step(network, only)(lesson.batch)
    before = network(lesson.batch)

    chosen = before.details.rows.pack(lesson.batch.details.offset)[:, None]
    assert likely(after.details.offset_logits, chosen) > likely(
        before.details.offset_logits, chosen
    )
    moved = copy.deepcopy(network)
    with torch.no_grad():
        moved.details.offset_bins.alone[-1].bias[0] += 2.0
    other = moved(lesson.batch)
    assert divergence(before, before, lesson) == 0
    assert divergence(other, before, lesson) > 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_insertions_and_removals_become_as_likely_as_their_rollouts_are_good(
    network, lessons, sign
):
    """More insertions where those that there were were good, and fewer where bad."""
    lesson = next(each for each in lessons.lessons if each.batch.entries.add.any())
    entries, removed = (
        lesson.batch.entries,
        lesson.batch.agents.presence == Presence.REMOVED,
    )
    scene, token = entries.add.any(dim=2).nonzero()[0].tolist()
    only = worthless(lesson)
    only.count_advantage[scene, token] = sign

    before, after = (each(lesson.batch) for each in (network, after_a_step(network, only)))

    def inserts(outputs):
        count = entries.count[scene, token]
        logits = outputs.entries.rows.spread(outputs.entries.add_logit)[scene, token]
        return logsigmoid(logits[:count]).sum() + logsigmoid(-logits[count])

    def removes(outputs):
        logits = outputs.motion.rows.spread(outputs.motion.remove_logit)
        may = lesson.moved[scene, token - 1, 1:]
        logits = logits[scene, token - 2, 1:][may]
        happened = removed[scene, token - 1, 1:][may]
        return logsigmoid(torch.where(happened, logits, -logits)).sum()

    gain = sum(part(after) - part(before) for part in (inserts, removes))
    assert sign * gain > 0


def test_without_penalties_nothing_is_better_than_anything_else(network, logged):
    names = (
        "overlap",
        "off_road",
        "log_distance",
        "placement",
        "speed",
        "ego_speed",
        "agent_type",
        "count",
    )
    free = replace(HOW, **{f"{name}_penalty": 0 for name in names})

    for lesson in simulate_lessons(network, logged, free, 5).lessons:
        assert not lesson.advantage.any()
        assert not lesson.type_advantage.any()
        assert not lesson.count_advantage.any()


def test_networks_of_all_kinds_learn_from_rollouts(variant, new_network, logged):
    network = new_network(variant).eval()
    lesson = simulate_lessons(network, logged, HOW, 1).lessons[0]

    found = terms(network, copy.deepcopy(network), lesson)
    (found["policy"].mean + found["divergence"].mean).backward()

    assert abs(found["divergence"].mean) < ROUNDING
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert all(torch.isfinite(each).all() for each in gradients)
    assert steepest(network) > 0


def test_figures_are_means_of_the_rollouts(lessons):
    sums = dict.fromkeys(SUMS, 0.0)
    sums |= {"choices": 50, "reward": -5, "overlap": 2, "agents": 8, "token_steps": 10}
    sums |= {"overlapping_agents": 2, "present": 40, "logged": 60, "entries": 5}

    found = figures(torch.tensor([float(sums[name]) for name in SUMS]))

    assert found["rollout_reward"] == pytest.approx(-0.1)
    assert found["rollout_overlap"] == pytest.approx(0.04)
    assert found["rollout_overlapping_agents"] == pytest.approx(0.25)
    assert found["rollout_agents"] == 4
    assert found["rollout_agents_logged"] == 6
    assert found["rollout_entries"] == pytest.approx(0.5)
    seen = dict(zip(SUMS, lessons.sums.tolist(), strict=True))
    moved = sum(int(each.moved.sum()) for each in lessons.lessons)
    assert seen["choices"] == moved + seen["entries"]
