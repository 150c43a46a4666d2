"""Log-probabilities of a nucleus, and what is sampled by them."""

import pytest
import torch

from infgen.model.training.own_choices import UniformNumbers
from infgen.model.training.policy_gradient.nucleus import log_probabilities, sample
from infgen.rollout.sampling import choose

SHARES = torch.tensor([[0.1, 0.3, 0.05, 0.5, 0.05]])
STANDS = torch.tensor([[True, False, True, False, False]])


def test_the_whole_nucleus_is_the_distribution():
    found = log_probabilities(SHARES.log(), STANDS, 1.0)

    torch.testing.assert_close(found.exp(), SHARES)


def test_those_who_stand_and_those_who_move_keep_their_share():
    found = log_probabilities(SHARES.log(), STANDS, 0.5)

    # 0.1 of 0.15 is more than a half, and so is 0.5 of 0.85.
    expected = torch.tensor([[0.15, 0.0, 0.0, 0.85, 0.0]])
    torch.testing.assert_close(found.exp(), expected, atol=1e-6, rtol=0)
    found = log_probabilities(SHARES.log(), STANDS, 0.7)
    # Both are less than 0.7: the next likely one of each joins them.
    expected = torch.tensor([[0.1, 0.85 * 3 / 8, 0.05, 0.85 * 5 / 8, 0.0]])
    torch.testing.assert_close(found.exp(), expected, atol=1e-6, rtol=0)


def test_a_choice_outside_may_be_named_and_then_has_a_probability():
    found = log_probabilities(SHARES.log(), STANDS, 0.5, torch.tensor([4]))

    assert torch.isfinite(found[0, 4])
    assert found.exp().sum() == pytest.approx(1.0)


def test_groups_without_a_choice_do_no_harm():
    logits = SHARES.log().requires_grad_()

    found = log_probabilities(logits, torch.zeros_like(STANDS), 0.6)
    found[0, 3].backward()

    assert found.exp().sum().item() == pytest.approx(1.0)
    assert torch.isfinite(logits.grad).all()


def test_choices_are_those_of_rollouts():
    logits = torch.randn(2000, 40, generator=torch.Generator().manual_seed(0)) * 2
    apart = torch.arange(40).expand(2000, 40) < 7
    uniform = UniformNumbers(0, torch.device("cpu")).draw(2000)

    likely = log_probabilities(logits, apart, 0.9)
    chosen = sample(likely, uniform)
    theirs = choose(logits, uniform, nucleus=0.9, apart=apart)

    assert torch.isfinite(likely.gather(1, chosen[:, None])).all()
    assert torch.isfinite(likely.gather(1, theirs[:, None])).all()
    # Both are samples of one distribution, by other numbers.
    expected = likely.exp().mean(dim=0)
    for each in (chosen, theirs):
        share = torch.bincount(each, minlength=40) / 2000
        torch.testing.assert_close(share, expected, atol=0.02, rtol=0)
