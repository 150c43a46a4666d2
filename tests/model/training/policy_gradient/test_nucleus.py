"""Log-probabilities of what was sampled from a nucleus."""

import pytest
import torch

from infgen.model.sampling import choose
from infgen.model.training.own_choices import UniformNumbers
from infgen.model.training.policy_gradient.nucleus import log_probability
from tests.model.training.policy_gradient.nuclei import nucleus_distribution

SHARES = torch.tensor([[0.1, 0.3, 0.05, 0.5, 0.05]])
STANDS = torch.tensor([[True, False, True, False, False]])


def probability(top_p: float, chosen: int) -> float:
    found = log_probability(SHARES.log(), STANDS, top_p, torch.tensor([chosen]))
    return found.exp().item()


@pytest.mark.parametrize("chosen", range(5))
def test_the_whole_nucleus_is_the_distribution(chosen):
    assert probability(1.0, chosen) == pytest.approx(SHARES[0, chosen].item())


def test_those_who_stand_and_those_who_move_keep_their_share():
    # 0.1 of 0.15 is more than a half, and so is 0.5 of 0.85.
    assert probability(0.5, 0) == pytest.approx(0.15)
    assert probability(0.5, 3) == pytest.approx(0.85)
    # Both are less than 0.7: the next likely one of each joins them.
    assert probability(0.7, 0) == pytest.approx(0.1)
    assert probability(0.7, 2) == pytest.approx(0.05)
    assert probability(0.7, 1) == pytest.approx(0.85 * 3 / 8)
    assert probability(0.7, 3) == pytest.approx(0.85 * 5 / 8)


def test_a_choice_outside_its_nucleus_has_a_probability():
    assert probability(0.5, 4) == pytest.approx(0.85 * 0.05 / 0.55)


def test_groups_without_a_choice_do_no_harm():
    logits = SHARES.log().requires_grad_()

    found = log_probability(logits, torch.zeros_like(STANDS), 0.6, torch.tensor([3]))
    found[0].backward()

    assert found.exp().item() == pytest.approx(0.5 / 0.8)
    assert torch.isfinite(logits.grad).all()


def test_the_gradient_is_that_of_the_distribution_with_its_nucleus_fixed():
    logits = SHARES.log().double().requires_grad_()

    log_probability(logits, STANDS, 0.7, torch.tensor([1]))[0].backward()

    # p(1) = (p1 + p3 + p4) * p1 / (p1 + p3): a step of a logit moves all of these.
    own, group, kept = (
        torch.tensor([0, 1, 0, 0, 0]),
        ~STANDS[0],
        torch.tensor([0, 1, 0, 1, 0]),
    )
    expected = own - SHARES[0] + SHARES[0] * group / 0.85 - SHARES[0] * kept / 0.8
    torch.testing.assert_close(logits.grad[0].float(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("choices", "sharpness"), [(40, 2.0), (2048, 0.5), (2048, 6.0)])
def test_choices_of_rollouts_have_the_probabilities_they_are_sampled_by(choices, sharpness):
    logits = (
        torch.randn(400, choices, generator=torch.Generator().manual_seed(0)) * sharpness
    )
    apart = torch.arange(choices).expand(400, choices) < choices // 6
    uniform = UniformNumbers(0, torch.device("cpu")).draw(400)

    chosen = choose(logits, uniform, nucleus=0.9, apart=apart)
    found = log_probability(logits, apart, 0.9, chosen)

    expected = nucleus_distribution(logits, apart, 0.9).gather(1, chosen[:, None])[:, 0]
    torch.testing.assert_close(found.exp().double(), expected, atol=0, rtol=1e-4)


def test_choices_are_as_frequent_as_their_probabilities():
    logits = torch.randn(1, 40, generator=torch.Generator().manual_seed(0)) * 2
    logits = logits.expand(20_000, 40)
    apart = torch.arange(40).expand(20_000, 40) < 7
    uniform = UniformNumbers(0, torch.device("cpu")).draw(20_000)

    chosen = choose(logits, uniform, nucleus=0.9, apart=apart)
    share = torch.bincount(chosen, minlength=40).double() / 20_000

    expected = nucleus_distribution(logits[:1], apart[:1], 0.9)[0]
    torch.testing.assert_close(share, expected, atol=0.02, rtol=0)
