"""What is supervised, on lives written by hand, and what each term is worth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.batching.supervision import motion_mask, stay_mask
from infgen.model.training.losses import figures, losses, total
from infgen.tokens.scene_tokens import FIRST_MOTION_TOKEN, NO_MOTION_TOKEN, Presence

LETTERS = {
    ".": (Presence.ABSENT, False, NO_MOTION_TOKEN),
    "E": (Presence.INSERTED, False, FIRST_MOTION_TOKEN),
    "p": (Presence.PRESENT, True, 0),
    "-": (Presence.PRESENT, False, NO_MOTION_TOKEN),  # A gap in the log.
    "L": (Presence.REMOVED, True, 0),
}


def agents_of(record, limits, life, near=True):
    """The ego and one agent whose life is spelt out, token by token."""
    scene = record(0, agents=2, tokens=len(life), lives=[(0, len(life) - 1)])
    presence, observed, motion_token = (
        np.array([LETTERS[letter][i] for letter in life]) for i in range(3)
    )
    change = {"presence": presence, "observed": observed, "motion_token": motion_token}
    arrays = {name: getattr(scene, name).copy() for name in change}
    for name, values in change.items():
        arrays[name][1] = values
    scene = replace(scene, **arrays, near=np.array([True, near]))
    return collate([scene], limits, 0).agents


def marks(mask):
    return "".join("x" if m else "." for m in mask[0, :, 1].tolist())


@pytest.mark.parametrize(
    ("life", "supervised"),
    [
        ("Epppp", "xxxx."),  # There throughout: every next move but the unknown last.
        (
            "..Epp",
            "..xx.",
        ),  # A inserted agent's first move is supervised, and the one after.
        ("EppL.", "xxx.."),  # Nothing after leaving.
        ("EL...", "x...."),
        ("....E", "....."),  # Entering at the last token: nothing follows.
        ("Epp-pp", "xx...."),  # A gap: neither into it, nor from it, nor just after it.
        ("Epp-ppp", "xx...x."),
        ("E-ppp", "...x."),
    ],
)
def test_moves_that_are_supervised(record, limits, life, supervised):
    assert marks(motion_mask(agents_of(record, limits, life))) == supervised


def test_agents_that_are_never_near_have_no_motion_loss(record, limits):
    agents = agents_of(record, limits, "Epppp", near=False)

    assert marks(motion_mask(agents)) == "....."
    assert motion_mask(agents)[0, :, 0].tolist() == [True] * 4 + [False]


@pytest.mark.parametrize(
    ("life", "decided"),
    [
        ("Epppp", "xx..."),  # The log ends: who is lost as it does may have come back.
        ("EppL.", "xx..."),
        ("EppL..", "xxx..."),  # Up to the token before the last, nothing after.
        ("..EL..", "..x..."),
        ("EL...", "x...."),
        ("....E", "....."),
        ("Ep-pL..", "xx.x..."),  # No decision where the agent is not seen.
    ],
)
def test_decisions_to_stay_or_leave(record, limits, life, decided):
    assert marks(stay_mask(agents_of(record, limits, life))) == decided


@pytest.mark.parametrize(("after", "decided"), [(0, 1), (1, 2), (2, 3), (3, 3)])
def test_a_part_of_a_log_ends_later_than_it_seems(record, limits, after, decided):
    scene = record(0, agents=2, tokens=4 + after, lives=[(0, 3 + after)])

    part = _scene_from_its_start(scene, limits, tokens=4)

    assert stay_mask(part.agents)[0, :, 1].sum() == decided
    assert part.entries.asked[0].tolist() == [False, True, True, after > 0]


def _scene_from_its_start(scene, limits, tokens):
    """Its first tokens alone: which part of a log is taken is up to the draw."""
    for draw in range(99):
        part = collate([scene], replace(limits, tokens=tokens), draw)
        if np.allclose(part.agents.pose[0, :, 0], scene.pose[0, :tokens]):
            return part
    raise AssertionError("no draw begins with the log")


def test_the_ego_never_decides_to_leave(record, limits):
    assert not stay_mask(agents_of(record, limits, "Epppp"))[0, :, 0].any()


@pytest.fixture
def settings():
    return TrainSettings(first_motion_weight=3.0, label_smoothing=0.0)


def terms_of(network, scenes, limits, settings):
    batch = collate(scenes, limits, 0)
    outputs = network(batch, hidden_roads=True)
    return batch, outputs, losses(outputs, batch, settings)


def test_add_is_asked_once_per_newcomer_and_begin_once(network, record, limits, settings):
    # Two inserted agents at token 2, none at 1 and 3; at the last token nobody can come.
    scene = record(8, tokens=5, lives=[(0, 4), (2, 4), (2, 4)], spread_m=20.0)

    _, _, terms = terms_of(network, [scene], limits, settings)

    assert float(terms["add"].count) == 1 + 3 + 1
    assert float(terms["add"].event) == 2
    assert float(terms["position"].count) == 2
    assert float(terms["agent_type"].count) == 2
    assert float(terms["size"].count) == 2


def test_more_newcomers_than_slots_leave_begin_unasked(network, record, limits, settings):
    scene = record(8, tokens=4, lives=[(1, 3)] * 6, spread_m=20.0)

    batch, _, terms = terms_of(network, [scene], limits, settings)

    assert batch.entries.count.tolist() == [[0, 6, 0, 0]]
    assert float(terms["add"].count) == (limits.entries + 1) + 1
    assert float(terms["add"].event) == limits.entries + 1


def test_newcomers_outside_the_grid_are_not_asked_for(network, record, limits, settings):
    scene = record(8, tokens=3, lives=[(1, 2)], spread_m=20.0)
    far = replace(
        scene,
        cell=np.where(np.arange(2)[:, None] == 1, -1, scene.cell).astype(np.int16),
        insertion_cell=np.where(
            scene.insertion_agent == 1, -1, scene.insertion_cell
        ).astype(np.int16),
    )

    _, _, terms = terms_of(network, [far], limits, settings)

    assert float(terms["add"].event) == 0
    assert float(terms["position"].count) == 0


def test_the_label_is_learned_and_not_the_move(network, record, limits, settings):
    batch = collate([record(3, agents=6, tokens=7, roads=40)], limits, 0)
    label = torch.where(batch.agents.label >= 0, 5, batch.agents.label)
    other = replace(batch, agents=replace(batch.agents, label=label))
    outputs = network(batch)

    said = outputs.motion.motion_logits.new_zeros(outputs.motion.motion_logits.shape)
    said[:, 5] = 50.0
    sure = replace(outputs, motion=replace(outputs.motion, motion_logits=said))

    assert float(losses(sure, other, settings)["motion"].mean) < 1e-4
    assert float(losses(sure, batch, settings)["motion"].mean) > 10


def test_the_first_move_of_a_newcomer_counts_three_times(network, record, limits, settings):
    scene = record(8, tokens=4, lives=[(2, 3)])

    with torch.no_grad():
        batch, outputs, terms = terms_of(network, [scene], limits, settings)

    # The ego: 3 moves, the first from token 0, where everybody starts. The inserted agent:
    # 1.
    assert float(terms["motion"].count) == 4
    assert float(terms["motion"].weight) == 3 + 3
    logits = outputs.motion.rows.spread(outputs.motion.motion_logits)[0].log_softmax(-1)
    motion_token = batch.agents.motion_token[0]
    ego = sum(-float(logits[k, 0, motion_token[k + 1, 0]]) for k in range(3))
    inserted = -float(logits[2, 1, motion_token[3, 1]])
    assert float(terms["motion"].mean) == pytest.approx((ego + 3 * inserted) / 6, rel=1e-5)


def test_label_smoothing_has_its_floor(network, record, limits):
    settings = TrainSettings(label_smoothing=0.1)
    batch, outputs, _ = terms_of(network, [record(1)], limits, settings)
    moves = outputs.motion.motion_logits.shape[-1]
    agents = batch.agents
    target = outputs.motion.rows.pack(torch.roll(agents.motion_token, -1, dims=1)).clamp(
        min=0
    )
    best = torch.full((len(target), moves), math.log(0.1 / moves))
    best.scatter_(1, target[:, None], math.log(0.9 + 0.1 / moves))

    perfect = replace(outputs, motion=replace(outputs.motion, motion_logits=best))
    term = losses(perfect, batch, settings)["motion"]

    sure, unsure = 0.9 + 0.1 / moves, 0.1 / moves
    floor = -sure * math.log(sure) - (moves - 1) * unsure * math.log(unsure)
    assert float(term.mean) == pytest.approx(floor, abs=1e-5)
    assert float(term.right) == float(term.count)


def test_nothing_supervised_is_a_loss_of_zero_with_gradients(
    network, record, limits, settings
):
    # One column: no next token, no query, no detail.
    _, _, terms = terms_of(network, [record(1, tokens=1, roads=0)], limits, settings)

    loss = total(terms, settings)
    loss.backward()

    assert float(loss.detach()) == 0
    assert all(float(term.count) == 0 for term in terms.values())


def test_terms_of_batches_add_up_to_the_term_of_all(network, record, limits, settings):
    one, two = record(1, agents=6), record(2, agents=11)
    _, _, first = terms_of(network, [one], limits, settings)
    _, _, second = terms_of(network, [two], limits, settings)
    _, _, both = terms_of(network, [one, two], limits, settings)

    for name, term in both.items():
        added = first[name] + second[name]
        assert float(added.count) == float(term.count)
        torch.testing.assert_close(added.mean, term.mean, atol=1e-4, rtol=1e-4)


def test_figures_name_every_term_with_its_count(network, record, limits, settings):
    _, _, terms = terms_of(network, [record(3, agents=12, tokens=9)], limits, settings)

    found = figures(terms)

    names = "motion keep add position agent_type size heading offset map"
    assert {*names.split()} <= found.keys()
    assert {f"{name}_count" for name in names.split()} <= found.keys()
    assert 0 <= found["motion_accuracy"] <= 1
    assert 0 <= found["keep_predicted"] <= 1
    assert found["keep_logged"] == pytest.approx(
        float(terms["keep"].event) / float(terms["keep"].count)
    )


def test_the_total_weighs_every_term_as_the_settings_say(network, record, limits, settings):
    _, _, terms = terms_of(network, [record(3)], limits, settings)

    weights = {name: getattr(settings, f"{name}_weight") for name in terms}
    wanted = sum(weights[name] * float(term.mean.detach()) for name, term in terms.items())

    assert float(total(terms, settings).detach()) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.slow
def test_a_tiny_scene_can_be_learnt_by_heart(new_network, tiny, record, limits):
    settings = TrainSettings(label_smoothing=0.0)
    network = new_network(replace(tiny, map_blocks=1, motion_blocks=1, scene_blocks=1))
    batch = collate([record(3, agents=6, tokens=7, roads=40)], limits, 0)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2, fused=True)
    for _ in range(110):
        terms = losses(network(batch, hidden_roads=True), batch, settings)
        optimiser.zero_grad()
        total(terms, settings).backward()
        optimiser.step()

    found = figures(terms)
    assert found["motion"] < 0.2
    assert found["motion_accuracy"] > 0.95
    for name in ("keep", "add", "position", "agent_type", "heading"):
        assert found[name] < 0.1, name
    assert found["size"] < 0.02
    assert found["offset"] < 0.1
