"""Thirty seconds played with caches say what a plain pass over all columns says."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from infgen.tokens.scene_tokens import Presence
from tests.rollout.heard import Gaps, Listening, play, recompute
from tests.rollout.single_rules import only

CLOSE = 1e-4
NEAR = {"atol": CLOSE, "rtol": 0.0}
BUSY = {
    **only(insertion_mask=True, max_insertion_attempts=2),
    "max_agents": 20,
    "max_insertions": 2,
    "motion_top_k": 0,
    "add_bias": -0.7,
    "remove_bias": -2.2,
}
"""Agents come and go at every token step, rows run out and are used again at once."""


@pytest.fixture
def starts(crossing, start):
    """Two rollouts of a crossing and one of a built-in town."""
    town = min(builtin_records(), key=lambda path: path.stat().st_size)
    (scene,) = islice(iter_scenes(town), 1)
    return [start(crossing(), 0), start(crossing(), 1), start(scene, 0)]


@pytest.fixture
def listening(simulator):
    """``listening(model={}, stepper=Listening)``: a player that keeps what is said."""

    def build(model=None, stepper=Listening, **settings):
        playing = simulator(
            {"temporal_window_tokens": 6, **(model or {})}, **{**BUSY, **settings}
        )
        network = playing.stepper.network
        torch.manual_seed(1)
        for parameter in network.parameters():  # No gain of 1, no bias of 0.
            parameter.data += 0.05 * torch.randn_like(parameter)
        return replace(playing, stepper=stepper(network))

    return build


def compare(simulator, starts, half_seconds):
    """Play and recompute: what was played, and how far the logits are apart."""
    played = play(simulator, starts, half_seconds)
    return played, Gaps(played, *recompute(simulator.stepper.network, played))


def test_every_logit_of_thirty_seconds_is_that_of_a_plain_pass(starts, listening):
    played, gaps = compare(listening(), starts, 60)

    entering = (played.presence == Presence.INSERTED)[2:]
    exits = (played.presence == Presence.REMOVED).sum(axis=(0, 2))
    assert played.tokens == 2 + 60
    # How many there are differs between kinds of processors: draws near a boundary do.
    assert (entering.sum(axis=(0, 2)) >= 10).all()
    assert (exits >= 10).all()
    assert entering.sum() > 2 * entering.any(axis=0).sum(), "rows are used again"
    tries = sum(len(one.rollout) for one in played.details)
    assert tries > 1.2 * entering.sum(), "places are refused"
    assert set(gaps.compared) == {
        *("motion_logits", "remove_logit"),
        *("add_logit", "position_logits"),
        *("agent_type_logits", "size_lwh_m", "heading_logits", "offset_m"),
    }
    assert min(gaps.compared.values()) > 200
    assert max(gaps.largest.values()) < CLOSE, gaps.largest


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        ({"validity_pattern_tokens": True}, {"validity_patterns": True}),
        ({"remove_token": False, "position_token": False}, {"removal_radius_m": 40.0}),
        ({"heading_token": False, "motion_blocks": 2, "scene_blocks": 2}, {}),
        ({"offset_token": True, "cell_feature_width": 8}, {"add_bias": 2.0}),
        ({"relations": "rotary", "cell_feature_width": 8}, {"add_bias": 2.0}),
    ],
)
def test_the_same_holds_for_variants(starts, listening, model, settings):
    playing = listening(model, **settings)

    played, gaps = compare(playing, starts[:2], 10)

    assert (played.presence == Presence.INSERTED)[2:].sum() >= 3
    assert max(gaps.largest.values()) < CLOSE, gaps.largest


class Forgetful(Listening):
    """Loses the oldest column that it should remember."""

    def motion_step(self, memory, token_step, rows=None):
        said = super().motion_step(memory, token_step, rows)
        memory.visible[:, :, memory.columns % memory.window] = False
        return said


class Mixed(Listening):
    """Takes what one agent was for what its neighbour was."""

    def motion_step(self, memory, token_step, rows=None):
        said = super().motion_step(memory, token_step, rows)
        memory.features = memory.features.roll(1, dims=2)
        return said


class Blind(Listening):
    """Asks for inserted agents without seeing those before."""

    def entry_add(self, entries, token_step, fresh=None):
        seen = super().entry_add(entries, token_step, fresh)
        inserted = (token_step.presence == Presence.INSERTED).any()
        return replace(seen, within=entries.within) if inserted else seen


@pytest.mark.parametrize(
    ("broken", "wrong"),
    [(Forgetful, "motion_logits"), (Mixed, "motion_logits"), (Blind, "position_logits")],
)
def test_a_broken_memory_is_found(starts, listening, broken, wrong):
    playing = listening(stepper=broken)

    _, gaps = compare(playing, starts[:1], 9)

    assert gaps.largest[wrong] > 10 * CLOSE


def test_alone_or_among_thirty_two_the_network_says_the_same(start, crossing, listening):
    scene, half_seconds, chosen = crossing(), 8, 17
    playing = listening()
    together = play(playing, [start(scene, at) for at in range(32)], half_seconds).heard
    alone = play(listening(), [start(scene, chosen)], half_seconds).heard

    for one, beside in zip(alone.columns, together.columns, strict=True):
        np.testing.assert_array_equal(one.motion_token[0], beside.motion_token[chosen])
        np.testing.assert_array_equal(one.presence[0], beside.presence[chosen])
    for one, beside in zip(alone.motion, together.motion, strict=True):
        torch.testing.assert_close(
            one.motion_logits[0], beside.motion_logits[chosen], **NEAR
        )
        torch.testing.assert_close(one.remove_logit[0], beside.remove_logit[chosen], **NEAR)
    assert len(alone.queries) > half_seconds
    for one in alone.queries:
        beside = next(
            other.said.take((other.rollout == chosen).nonzero()[:, 0])
            for other in together.queries
            if other.token == one.token
            and (other.turn[other.rollout == chosen] == one.turn).any()
        )
        torch.testing.assert_close(one.said.add_logit, beside.add_logit, **NEAR)
        torch.testing.assert_close(one.said.position_logits, beside.position_logits, **NEAR)
