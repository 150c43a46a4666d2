"""The likelihood under a latent rate is the mean over all that it may have been."""

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from infgen.model.latent_rates import LatentRates, Rate, RateProcess
from infgen.model.training.rate_likelihood import Decisions, rate_likelihood

SCENES, TOKENS = 2, 3


def process(scale=0.7, persistence=0.8, mean=-0.2):
    return RateProcess(*(torch.tensor([each, 0.0]) for each in (mean, scale, persistence)))


@pytest.fixture
def decisions():
    generator = torch.Generator().manual_seed(0)
    count = 14
    token_step = torch.randint(0, SCENES * TOKENS, (count,), generator=generator)
    token_step[token_step == 1] = 0  # A token step in which nothing is decided.
    return Decisions(
        torch.randn(count, generator=generator),
        (torch.rand(count, generator=generator) < 0.4).float(),
        token_step,
    )


def test_it_is_the_sum_over_all_paths(decisions):
    rates = process()
    nodes, prior = rates.nodes(), rates.log_prior()
    step = rates.log_transition()[Rate.INSERTION]
    added = rates.mean[0] + rates.scale[0] * nodes
    each = -functional.binary_cross_entropy_with_logits(
        decisions.logit[:, None] + added,
        decisions.happens[:, None].expand(-1, len(nodes)),
        reduction="none",
    )
    total = 0.0
    for scene in range(SCENES):
        of_token = [
            each[decisions.token_step == scene * TOKENS + token].sum(dim=0)
            for token in range(TOKENS)
        ]
        path = prior[:, None, None] + step[:, :, None] + step
        path = path + of_token[0][:, None, None] + of_token[1][:, None] + of_token[2]
        total += float(path.flatten().logsumexp(dim=0))

    found = rate_likelihood(decisions, Rate.INSERTION, rates, SCENES, TOKENS)

    assert float(found.loss) == pytest.approx(-total, abs=1e-4)


def test_without_variation_decisions_are_independent(decisions):
    rates = process(scale=0.0, mean=0.3)

    found = rate_likelihood(decisions, Rate.INSERTION, rates, SCENES, TOKENS)

    logit = decisions.logit + 0.3
    loss = functional.binary_cross_entropy_with_logits(
        logit, decisions.happens, reduction="sum"
    )
    torch.testing.assert_close(found.loss, loss)
    torch.testing.assert_close(found.predicted, logit.sigmoid().sum())


def test_scenes_and_the_order_of_decisions_do_not_matter_to_each_other(decisions):
    rates = process()
    both = rate_likelihood(decisions, Rate.INSERTION, rates, SCENES, TOKENS)
    backwards = Decisions(
        *(
            each.flip(0)
            for each in (decisions.logit, decisions.happens, decisions.token_step)
        )
    )
    alone = 0.0
    for scene in range(SCENES):
        own = decisions.token_step // TOKENS == scene
        only = Decisions(
            decisions.logit[own],
            decisions.happens[own],
            decisions.token_step[own] % TOKENS,
        )
        alone += float(rate_likelihood(only, Rate.INSERTION, rates, 1, TOKENS).loss)

    again = rate_likelihood(backwards, Rate.INSERTION, rates, SCENES, TOKENS)

    torch.testing.assert_close(again.loss, both.loss)
    assert alone == pytest.approx(float(both.loss), abs=1e-4)


def test_decisions_that_do_not_count_are_as_if_they_were_not_there(decisions):
    rates, kept = process(), torch.arange(len(decisions.logit)) % 3 > 0
    some = Decisions(
        decisions.logit[kept], decisions.happens[kept], decisions.token_step[kept]
    )
    masked = Decisions(
        decisions.logit, decisions.happens, decisions.token_step, kept.float()
    )

    one, other = (
        rate_likelihood(each, Rate.INSERTION, rates, SCENES, TOKENS)
        for each in (some, masked)
    )

    torch.testing.assert_close(one.loss, other.loss)
    torch.testing.assert_close(one.predicted, other.predicted)


def varying_events(scenes, tokens, decisions, scale, persistence):
    """Sample events of a known process: log-odds, and what happened."""
    rng = np.random.default_rng(3)
    value, values = rng.standard_normal(scenes), []
    for _ in range(tokens):
        values.append(value)
        fresh = rng.standard_normal(scenes)
        value = persistence * value + math.sqrt(1 - persistence**2) * fresh
    rate = scale * np.stack(values, axis=1)[..., None]
    logit = rng.normal(-1.0, 0.5, (scenes, tokens, decisions))
    happens = rng.random(logit.shape) < 1 / (1 + np.exp(-logit - rate))
    token_step = np.arange(scenes * tokens).repeat(decisions)
    return Decisions(
        torch.from_numpy(logit.ravel()).float(),
        torch.from_numpy(happens.ravel()).float(),
        torch.from_numpy(token_step),
    )


def test_the_process_that_made_events_is_found_again():
    scenes, tokens = 48, 40
    decisions = varying_events(scenes, tokens, 12, scale=0.8, persistence=0.9)
    rates = LatentRates()
    adam = torch.optim.Adam(rates.parameters(), lr=0.08)
    for _ in range(80):
        adam.zero_grad()
        rate_likelihood(decisions, Rate.REMOVAL, rates(), scenes, tokens).loss.backward()
        adam.step()

    mean, scale, persistence = rates().on_host()[:, Rate.REMOVAL].tolist()
    assert mean == pytest.approx(0, abs=0.15)
    assert scale == pytest.approx(0.8, abs=0.12)
    assert persistence == pytest.approx(0.9, abs=0.04)
    scale = float(rates().on_host()[1, Rate.INSERTION])
    assert scale == pytest.approx(0.1), "nothing was told of insertions"


def test_untrained_rates_have_gradients(decisions):
    rates = LatentRates()

    rate_likelihood(decisions, Rate.REMOVAL, rates(), SCENES, TOKENS).loss.backward()

    for parameter in rates.parameters():
        assert parameter.grad[Rate.REMOVAL] != 0
        assert parameter.grad[Rate.INSERTION] == 0


def test_two_independent_token_steps_by_hand():
    rates = process(scale=1.0, persistence=0.0, mean=0.0)
    decisions = Decisions(torch.zeros(2), torch.tensor([1.0, 0.0]), torch.tensor([0, 1]))

    found = rate_likelihood(decisions, Rate.INSERTION, rates, 1, 2)

    # By symmetry either is as likely as not, whatever the scale.
    assert float(found.loss) == pytest.approx(2 * math.log(2), abs=1e-5)
    assert float(found.predicted) == pytest.approx(1.0, abs=1e-5)
