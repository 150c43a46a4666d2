import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from infgen.model.sampling import choose, sample_event


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

    result = sample_event(
        torch.tensor(logit, dtype=torch.float64), torch.tensor(uniform, dtype=torch.float64)
    )

    assert result.item() == expected.item()


def shares_of(shares, **sampling):
    """How often each choice of known shares is made, for 1000 evenly spread numbers."""
    logits = torch.log(torch.tensor(shares, dtype=torch.float64)).repeat(1000, 1)
    uniform = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    picks = choose(logits, uniform, **sampling)
    return torch.bincount(picks, minlength=len(shares)) / 1000


@pytest.mark.parametrize(
    ("sampling", "expected"),
    [
        ({}, [0.1, 0.2, 0.3, 0.4]),
        ({"top": 2}, [0, 0, 3 / 7, 4 / 7]),
        ({"nucleus": 0.39}, [0, 0, 0, 1]),  # The likeliest alone has the share asked for.
        ({"nucleus": 0.41}, [0, 0, 3 / 7, 4 / 7]),
        ({"nucleus": 0.8}, [0, 2 / 9, 3 / 9, 4 / 9]),
        ({"nucleus": 1.0}, [0.1, 0.2, 0.3, 0.4]),
        # Of the two likeliest the first has 4/7, more than half.
        ({"top": 2, "nucleus": 0.5}, [0, 0, 0, 1]),
        # Shares squared: 1, 4, 9, 16 of 30.
        ({"temperature": 0.5}, [1 / 30, 4 / 30, 9 / 30, 16 / 30]),
        ({"temperature": 0.5, "nucleus": 0.6}, [0, 0, 9 / 25, 16 / 25]),
        ({"temperature": 1e6}, [0.25, 0.25, 0.25, 0.25]),
    ],
)
def test_shares_are_those_computed_by_hand(sampling, expected):
    found = shares_of([0.1, 0.2, 0.3, 0.4], **sampling)

    torch.testing.assert_close(found, torch.tensor(expected).float(), atol=2e-3, rtol=0)


def test_the_largest_number_never_picks_what_cannot_be():
    logits = torch.tensor([[0.0, float("-inf"), -1.0, float("-inf")]])

    for nucleus in (1.0, 0.99):
        pick = choose(
            logits, torch.tensor([1 - 2**-53], dtype=torch.float64), nucleus=nucleus
        )
        assert pick.item() == 2


@pytest.mark.parametrize(("bias", "expected"), [(0.0, 0.5), (1.0, 0.731), (-2.0, 0.119)])
def test_a_bias_moves_the_log_odds(bias, expected):
    uniform = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 10_000

    share = sample_event(torch.zeros(10_000), uniform, bias).float().mean()

    assert float(share) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("apart", "nucleus", "expected"),
    [
        # Whoever seldom does the one thing still does: its probability stays 0.1.
        ([True, False, False, False], 0.5, [0.1, 0, 0.45, 0.45]),
        ([True, True, False, False], 0.6, [0, 0.3, 0.35, 0.35]),
        ([True, True, True, True], 0.5, [0, 0, 0.5, 0.5]),
        ([False, False, False, False], 0.5, [0, 0, 0.5, 0.5]),
        ([True, False, False, False], 1.0, [0.1, 0.2, 0.35, 0.35]),
    ],
)
def test_choices_set_apart_have_a_nucleus_of_their_own(apart, nucleus, expected):
    marks = torch.tensor(apart).expand(1000, -1)
    shares = [0.1, 0.2, 0.35, 0.35]

    found = shares_of(shares, nucleus=nucleus, apart=marks)

    assert torch.allclose(found, torch.tensor(expected), atol=2e-3)


@given(
    st.lists(st.tuples(st.floats(-9, 9), st.booleans()), min_size=1, max_size=9),
    st.floats(0.05, 0.99),
)
def test_a_nucleus_takes_no_probability_from_either_group(choices, nucleus):
    logits = torch.tensor([logit for logit, _ in choices], dtype=torch.float64)
    apart = torch.tensor([mark for _, mark in choices])
    uniform = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000

    picks = choose(
        logits.expand(2000, -1), uniform, nucleus=nucleus, apart=apart.expand(2000, -1)
    )

    expected = logits.softmax(dim=0)[apart].sum()
    assert abs(apart[picks].double().mean() - expected) < 2e-3


@given(
    st.integers(0, 10**6),
    st.sampled_from([0.5, 3.0, 9.0]),
    st.floats(0.3, 0.99),
    st.floats(0.5, 2.0),
)
def test_what_may_be_in_a_nucleus_is_sorted_alone_and_chosen_as_from_all(
    seed, spread, nucleus, temperature
):
    random = torch.Generator().manual_seed(seed)
    logits = spread * torch.randn(40, 700, generator=random)
    logits[:10, 3:] = -torch.inf
    apart = torch.rand(40, 700, generator=random) < 0.02
    uniform = torch.rand(40, generator=random, dtype=torch.float64)
    how = {"nucleus": nucleus, "temperature": temperature, "apart": apart}

    found, expected = (choose(logits, uniform, top=top, **how) for top in (0, 700))

    assert torch.equal(found, expected)
