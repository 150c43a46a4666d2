"""Latent rates are a stationary process of variance one, on a grid."""

import pytest
import torch

from infgen.model.latent_rates import LatentRates, Rate, RateProcess


def process(persistence):
    return RateProcess(torch.zeros(2), torch.ones(2), torch.tensor([persistence, 0.0]))


def test_an_untrained_rate_hardly_varies():
    rates = LatentRates()()

    assert rates.mean.tolist() == [0.0, 0.0]
    torch.testing.assert_close(rates.scale, torch.tensor([0.1, 0.1]))
    torch.testing.assert_close(rates.persistence, torch.tensor([0.9, 0.9]))
    assert rates.on_host().shape == (3, 2)


@pytest.mark.parametrize("persistence", [0.0, 0.5, 0.9, 0.98])
def test_the_process_is_stationary_with_variance_one(persistence):
    rates = process(persistence)
    prior, step = rates.log_prior().exp(), rates.log_transition()[Rate.INSERTION].exp()

    torch.testing.assert_close(step.sum(dim=1), torch.ones(len(prior)))
    assert float(prior @ rates.nodes().square()) == pytest.approx(1, abs=0.02)
    # The ends of the grid cut a little off.
    torch.testing.assert_close(prior @ step, prior, atol=4e-3, rtol=0)


@pytest.mark.parametrize("persistence", [0.0, 0.5, 0.9, 0.98])
def test_a_token_step_later_the_rate_is_the_same_but_for_a_share(persistence):
    rates = process(persistence)
    nodes, step = rates.nodes(), rates.log_transition()[Rate.INSERTION].exp()

    later = step @ nodes
    spread = step @ nodes.square() - later.square()

    middle = nodes.abs() < 1.2
    torch.testing.assert_close(
        later[middle], persistence * nodes[middle], atol=0.03, rtol=0
    )
    expected = torch.full((int(middle.sum()),), 1 - persistence**2)
    torch.testing.assert_close(spread[middle], expected, atol=0.03, rtol=0.1)
