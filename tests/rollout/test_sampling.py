import torch
from hypothesis import given
from hypothesis import strategies as st

from infgen.rollout.sampling import choose, happens


def test_a_uniform_number_picks_the_choice_whose_share_it_falls_in():
    # Shares 1/2, 1/4, 1/4 in order of likelihood: rows 2, 0, 1.
    logits = torch.log(torch.tensor([[0.25, 0.25, 0.5]]).double()).float()

    picks = [
        choose(logits, torch.tensor([u])).item() for u in (0.0, 0.49, 0.51, 0.74, 0.76)
    ]

    assert picks[:2] == [2, 2]
    assert sorted({picks[2], picks[4]}) == [0, 1]
    assert picks[2] == picks[3]


def test_only_the_likeliest_are_sampled():
    logits = torch.arange(10.0).repeat(1000, 1)
    uniform = torch.linspace(0, 1 - 1e-9, 1000, dtype=torch.float64)

    assert set(choose(logits, uniform, top=3).tolist()) == {7, 8, 9}


def test_the_largest_uniform_number_is_still_a_choice():
    logits = torch.zeros(1, 7)

    pick = choose(logits, torch.tensor([1 - 2**-53], dtype=torch.float64))

    assert 0 <= pick.item() < 7


def test_impossible_choices_are_never_made():
    logits = torch.tensor([0.0, float("-inf"), 0.0]).repeat(1000, 1)
    uniform = torch.linspace(0, 1 - 1e-9, 1000, dtype=torch.float64)

    assert set(choose(logits, uniform).tolist()) == {0, 2}


def test_frequencies_follow_the_probabilities():
    logits = torch.log(torch.tensor([0.1, 0.2, 0.7])).repeat(10_000, 1)
    uniform = torch.rand(10_000, dtype=torch.float64, generator=torch.manual_seed(0))

    counts = torch.bincount(choose(logits, uniform), minlength=3) / 10_000

    assert torch.allclose(counts, torch.tensor([0.1, 0.2, 0.7]), atol=0.02)


@given(st.floats(-20, 20), st.floats(0, 1, exclude_max=True))
def test_events_happen_with_their_probability(logit, uniform):
    expected = uniform < 1 / (1 + torch.exp(torch.tensor(-logit, dtype=torch.float64)))

    result = happens(
        torch.tensor(logit, dtype=torch.float64), torch.tensor(uniform, dtype=torch.float64)
    )

    assert result.item() == expected.item()
