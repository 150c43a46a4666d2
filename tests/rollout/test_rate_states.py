"""Latent rates of rollouts follow their process, and each rollout has its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.latent_rates import Rate
from infgen.rollout.begun_step import logged_step
from infgen.rollout.random_streams import Streams
from infgen.rollout.rate_states import RateStates
from infgen.rollout.session import Session
from tests.rollout.test_replacement import LIVELY, driven_step, replaced_at

PROCESS = np.array([[0.5, -1.0], [0.8, 2.0], [0.9, 0.6]])


def streams(count, seed=0):
    return Streams.of((seed, "scene", index) for index in range(count))


def played(own, tokens, states=None, first=2):
    """Log-odds [rate, token, rollout] of some token steps."""
    states = states or RateStates(PROCESS, len(own))
    found = []
    for token in range(first, first + tokens):
        states.advance(own, token)
        found.append([states.log_odds(rate) for rate in Rate])
    return np.array(found).swapaxes(0, 1)


def test_values_follow_the_process():
    log_odds = played(streams(4000), 30)

    for rate in Rate:
        mean, scale, persistence = PROCESS[:, rate]
        value = (log_odds[rate] - mean) / scale
        np.testing.assert_allclose(value.mean(axis=1), 0, atol=0.06)
        np.testing.assert_allclose(value.std(axis=1), 1, atol=0.05)
        for apart in (1, 3):
            same = (value[apart:] * value[:-apart]).mean()
            assert same == pytest.approx(persistence**apart, abs=0.03)
    both = (log_odds - PROCESS[0][:, None, None]) / PROCESS[1][:, None, None]
    assert (both[0] * both[1]).mean() == pytest.approx(0, abs=0.03)


def test_a_rollout_has_its_own_whatever_is_beside_it():
    one, other = streams(3), streams(3).take(np.array([1]))

    np.testing.assert_array_equal(played(one, 5)[:, :, [1]], played(other, 5))
    assert not np.array_equal(played(one, 5), played(streams(3, seed=1), 5))


def test_a_token_step_that_begins_again_changes_nothing():
    own, states = streams(3), RateStates(PROCESS, 3)
    states.advance(own, 2)
    before = states.log_odds(Rate.REMOVAL)

    states.advance(own, 2)

    np.testing.assert_array_equal(states.log_odds(Rate.REMOVAL), before)


def test_who_takes_a_place_begins_anew():
    own, others = streams(3), streams(2, seed=1)
    states, fresh = RateStates(PROCESS, 3), RateStates(PROCESS, 2)
    before = played(own, 4, states)
    at = np.array([0, 2])

    states.put(at, fresh)
    after = played(own.put(at, others, token=4), 3, states, first=6)

    np.testing.assert_array_equal(after[:, :, at], played(others, 3))
    np.testing.assert_array_equal(
        np.concatenate([before, after], axis=1)[:, :, 1], played(own, 7)[:, :, 1]
    )


@pytest.fixture
def varying(simulator):
    """``varying(mean, scale, **settings)``: a simulator with latent rates."""

    def build(mean, scale, **settings):
        playing = simulator({"latent_rates": True}, **settings)
        rates = playing.stepper.network.rates
        with torch.no_grad():
            rates.mean.copy_(torch.tensor(mean))
            rates.log_scale.copy_(torch.tensor(scale).log())
        return playing

    return build


def recorded(playing, starts, steps=4):
    session = Session(playing, starts)
    return [session.step() for _ in range(steps)]


def same(one, other):
    names = ("agent_number", "path", "removed", "inserted_number")
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for a, b in zip(one, other, strict=True)
        for name in names
    )


def test_rates_that_do_not_vary_change_nothing(varying, simulator, start, crossing):
    starts = [start(crossing(), at) for at in range(3)]
    plain, still = simulator(**LIVELY), varying([0.0, 0.0], [1e-30, 1e-30], **LIVELY)
    still.stepper.network.load_state_dict(plain.stepper.network.state_dict(), strict=False)

    assert same(recorded(plain, starts), recorded(still, starts))


def test_the_setting_scales_them_down_to_none(varying, simulator, start, crossing):
    starts = [start(crossing(), at) for at in range(3)]
    whole, half, none = (
        varying([0.4, -0.2], [2.0, 1.0], **LIVELY, latent_rate_scale=scale)
        for scale in (1.0, 0.5, 0.0)
    )
    plain = simulator(**LIVELY)
    none.stepper.network.load_state_dict(plain.stepper.network.state_dict(), strict=False)

    np.testing.assert_allclose(whole.rates, [[0.4, -0.2], [2, 1], [0.9, 0.9]], rtol=1e-6)
    np.testing.assert_allclose(half.rates, [[0.1, -0.05], [1, 0.5], [0.9, 0.9]], rtol=1e-6)
    assert none.rates is None
    assert same(recorded(plain, starts), recorded(none, starts))


@pytest.mark.parametrize(("insertion", "removal"), [(-50.0, 50.0), (50.0, -50.0)])
def test_rates_decide_who_is_inserted_and_removed(
    varying, start, crossing, insertion, removal
):
    playing = varying([insertion, removal], [1.0, 1.0], max_insertions=2, max_agents=24)

    first, *_ = recorded(playing, [start(crossing(), at) for at in range(2)])

    others = first.agent_number[:, 1:] >= 0
    assert (first.inserted_number >= 0).any() == (insertion > 0)
    assert others.any()
    assert (first.removed[:, 1:] == (others & (removal > 0))).all()
    assert not first.removed[:, 0].any(), "the ego stays"


def test_a_replaced_rollout_has_the_rates_that_it_would_have_alone(
    varying, start, crossing
):
    playing = varying([0.5, 0.0], [2.0, 1.0], **LIVELY)
    other = start(replace(crossing(speed_mps=8.0), scenario_id="other"))
    session = Session(playing, [start(crossing(), at) for at in range(3)])
    alone = Session(playing, other)
    for _ in range(2):
        driven_step(session)

    replaced_at(session, 1, other, logged_step([other], 24))

    for _ in range(4):
        many, one = driven_step(session), driven_step(alone)
        np.testing.assert_array_equal(many.agent_number[1], one.agent_number[0])
        np.testing.assert_array_equal(many.inserted_number[1], one.inserted_number[0])
