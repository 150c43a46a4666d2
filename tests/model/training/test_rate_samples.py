"""Latent rates of batches that the network simulates itself, as rollouts sample them."""

from dataclasses import replace

import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.latent_rates import Rate, RateProcess
from infgen.model.training.closed_loop_population import close_population_loop
from infgen.model.training.losses import losses, total
from infgen.model.training.own_choices import UniformNumbers
from infgen.model.training.policy_gradient.choices import choices_made
from infgen.model.training.policy_gradient.lessons import simulate_lessons
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    simulate_rollouts,
)
from infgen.model.training.rate_samples import RateSamples
from infgen.tokens.scene_tokens import EGO, Presence
from tests.model.conftest import TINY

MEAN, SCALE, PERSISTENCE = (0.5, -1.0), (2.0, 0.5), (0.8, 0.0)
ROLLOUTS = 20_000
HOW = TrainSettings(policy_gradient_rollouts=3, label_smoothing=0.0)


def process():
    return RateProcess(*map(torch.tensor, (MEAN, SCALE, PERSISTENCE)))


def sampled(process, rollouts, tokens, seed=0):
    uniforms = UniformNumbers(seed, torch.device("cpu"))
    rates = RateSamples(process, torch.zeros(rollouts, tokens, 5), uniforms)
    for token in range(1, tokens):
        rates.advance(token)
    return rates


@pytest.fixture(scope="module")
def logged(record, limits):
    return collate([record(3, tokens=9, spread_m=12.0), record(4, tokens=9)], limits, 7)


@pytest.fixture
def varying(new_network):
    """A network whose latent rates have given means and hardly vary."""

    def make(insertion, removal):
        network = new_network(replace(TINY, latent_rates=True)).eval()
        with torch.no_grad():
            network.rates.mean.copy_(torch.tensor([insertion, removal]))
            network.rates.log_scale.fill_(-20.0)
        return network

    return make


def test_from_token_step_to_token_step_rates_are_the_process():
    log_odds = sampled(process(), ROLLOUTS, 4).log_odds

    assert not log_odds[:, 0].any()
    for rate in Rate:
        z = (log_odds[:, 1:, rate] - MEAN[rate]) / SCALE[rate]
        assert z.mean(dim=0).abs().max() < 0.03
        torch.testing.assert_close(z.std(dim=0), torch.ones(3).double(), atol=0.03, rtol=0)
        for before, after in ((0, 1), (1, 2)):
            alike = float((z[:, before] * z[:, after]).mean())
            assert alike == pytest.approx(PERSISTENCE[rate], abs=0.03)
    both = log_odds[:, 1] - torch.tensor(MEAN)
    assert abs(float((both[:, 0] * both[:, 1]).mean())) < 0.03
    assert torch.equal(log_odds, sampled(process(), ROLLOUTS, 4).log_odds)
    assert not torch.equal(log_odds, sampled(process(), ROLLOUTS, 4, seed=1).log_odds)


def test_a_network_without_latent_rates_adds_nothing():
    rates = sampled(None, 3, 4)

    assert not rates.log_odds.any()
    assert rates.of(Rate.REMOVAL, 2).shape == (3,)


def test_scaled_rates_vary_by_so_much_less_and_have_means_of_its_square():
    half = process().scaled(0.5)

    torch.testing.assert_close(half.mean, torch.tensor(MEAN) / 4)
    torch.testing.assert_close(half.scale, torch.tensor(SCALE) / 2)
    torch.testing.assert_close(half.persistence, torch.tensor(PERSISTENCE))


@pytest.mark.parametrize(("insertion", "removal"), [(-50.0, 50.0), (50.0, -50.0)])
def test_rates_decide_who_is_inserted_and_removed(varying, logged, insertion, removal):
    network = varying(insertion, removal)

    found = simulate_rollouts(network, logged, 3, 0.9, 5)
    closed = close_population_loop(network, logged, 3, 5)

    presence = found.batch.agents.presence[:, HISTORY_TOKENS:]
    assert found.inserted.any() == (insertion > 0)
    removed = presence == int(Presence.REMOVED)
    moved = found.moved[:, HISTORY_TOKENS:].clone()
    moved[:, :, EGO] = False
    assert moved.any()
    assert torch.equal(removed & moved, moved & (removal > 0))
    rows = logged.agents.presence.shape[2]
    assert closed.agents.visible[..., rows:].any() == (insertion > 0)


def test_a_scale_of_zero_leaves_the_networks_own_odds(varying, logged):
    loud, quiet = varying(50.0, 50.0), varying(0.0, 0.0)
    quiet.load_state_dict(loud.state_dict())
    with torch.no_grad():
        quiet.rates.mean.zero_()

    one, other = (
        simulate_rollouts(each, logged, 3, 0.9, 5, latent_rate_scale=0.0)
        for each in (loud, quiet)
    )

    assert torch.equal(one.batch.agents.presence, other.batch.agents.presence)
    assert not one.rate_log_odds.any()


def test_choices_have_the_probability_that_they_were_sampled_with(varying, logged):
    """At odds of e to 50 what happened was certain: its log-probability is zero."""
    network = varying(-50.0, 50.0)
    stationary = torch.from_numpy(network.motion_vocabulary().stationary)
    lesson = simulate_lessons(network, logged, HOW, 5).lessons[0]
    none = replace(lesson, rate_log_odds=torch.zeros_like(lesson.rate_log_odds))

    with torch.no_grad():
        outputs = network(lesson.batch)
        as_sampled, without = (
            choices_made(outputs, each, stationary, 0.9).log_probability.sum()
            for each in (lesson, none)
        )

    decisions = int(lesson.removable.sum()) + int(lesson.batch.entries.asked.sum())
    assert decisions > 0
    assert as_sampled > without + 0.5 * decisions


def test_rates_are_learned_where_they_are_not_scaled_and_nowhere_else(varying, logged):
    def gradient(scale):
        network = varying(0.3, -0.2)
        settings = replace(HOW.of_the_log, latent_rate_scale=scale)
        total(losses(network(logged), logged, settings), settings).backward()
        return network.rates.mean.grad, float(network.cells.add[-1].bias.grad.abs().max())

    learned, head = gradient(1.0)
    held, held_head = gradient(0.5)

    assert learned.abs().max() > 0
    assert head > 0
    assert held is None
    assert held_head > 0
