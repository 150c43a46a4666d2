"""The gradient of a batch does not depend on how the batch is cut up."""

from dataclasses import replace

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from infgen.config import TrainSettings
from pipeline.stages.train.optimizer_step import OptimizerStep, learning_rate, noise_of_part
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import begin


def test_the_rate_rises_then_falls_as_half_a_cosine():
    how = TrainSettings(steps=110, warmup_steps=10, learning_rate=1.0)

    rates = [learning_rate(how, step) for step in range(110)]

    assert rates[0] == pytest.approx(0.1)
    assert rates[9] == rates[10] == pytest.approx(1.0)
    assert rates[60] == pytest.approx(0.5)
    assert 0 <= rates[-1] < 0.001
    assert learning_rate(replace(how, warmup_steps=0), 0) == 1.0


def test_every_part_of_every_step_has_its_own_dropout():
    draws = {
        noise_of_part(step, seed, part)
        for step in range(20)
        for seed in range(20)
        for part in range(20)
    }

    assert len(draws) == 8000


def test_small_seeds_give_the_dropout_that_finished_weights_were_made_with():
    assert noise_of_part(step=5, seed=3, part=2) == (3 << 48) + (2 << 32) + 5
    assert noise_of_part(0, 65535, 65535) == 0xFFFF_FFFF_0000_0000


@given(
    seed=st.integers(0, 2**63 - 1),
    part=st.integers(0, 2**16 - 1),
    step=st.integers(0, 2**32 - 1),
)
@example(seed=65535, part=65535, step=2**32 - 1)
@example(seed=65536, part=0, step=0)
@example(seed=2**63 - 1, part=1, step=7)
def test_torch_takes_the_dropout_of_any_seed(seed, part, step):
    noise = noise_of_part(step, seed, part)

    torch.Generator().manual_seed(noise)
    assert noise == noise_of_part(step, seed, part)
    assert noise != noise_of_part(step + 1, seed, part)
    assert seed < 65536 or noise != noise_of_part(step, seed - 1, part)


@pytest.mark.parametrize("seed", [65536, 2**63 - 1])
def test_a_step_is_done_with_a_large_seed(setup, books, seed):
    how = replace(setup.train, seed=seed)
    large = replace(setup, train=how)
    training, recipe = begin(large, *books), large.recipe(ProcessGroup())
    optimizer_step = OptimizerStep(training, how, ProcessGroup(), recipe.parts)

    stepped = optimizer_step.step(recipe[0], recipe.own, 0)

    assert stepped.norm > 0


@pytest.fixture
def descend(setup, books):
    """``descend(accumulate, steps)`` trains on batches of four, cut into so many parts."""

    def go_down(accumulate, steps=2):
        how = replace(
            setup.train,
            batch_scenes=4,
            gradient_accumulation=accumulate,
            learning_rate=2e-4,
        )
        model = replace(setup.model, dropout=0.0)
        cut = replace(setup, train=how, model=model)
        training = begin(cut, *books)
        recipe = cut.recipe(ProcessGroup())
        optimizer_step = OptimizerStep(training, how, ProcessGroup(), recipe.parts)
        found = [
            optimizer_step.step(recipe[step], recipe.own, step) for step in range(steps)
        ]
        return training, found

    return go_down


def test_parts_of_a_batch_give_the_gradient_of_the_whole(descend):
    whole, seen_whole = descend(1)

    for accumulate in (2, 4):
        cut, seen = descend(accumulate)
        for one, other in zip(seen_whole, seen, strict=True):
            assert other.norm == pytest.approx(one.norm, rel=1e-4)
            assert other.perplexity == pytest.approx(one.perplexity, rel=1e-4)
            for name, term in one.terms.items():
                assert float(other.terms[name].mean) == pytest.approx(
                    float(term.mean), rel=1e-4
                )
                assert float(other.terms[name].count) == float(term.count)
        for name, value in whole.network.state_dict().items():
            torch.testing.assert_close(
                cut.network.state_dict()[name], value, atol=1e-5, rtol=0
            )


def test_means_of_parts_would_not_be_the_same(setup, books):
    # Without inserted agents in one part, its mean of their kinds is not half of the
    # batch's.
    recipe = replace(
        setup, train=replace(setup.train, batch_scenes=2, gradient_accumulation=2)
    ).recipe(ProcessGroup())
    one, other = recipe[0]
    counts = [float((part.entries.agent >= 0).sum()) for part in (one, other)]
    few = replace(other.entries, agent=torch.full_like(other.entries.agent, -1))
    hidden = replace(other.details, inserted=torch.zeros_like(other.details.inserted))
    parts = [one, replace(other, entries=few, details=hidden)]

    found = OptimizerStep(begin(setup, *books), setup.train, ProcessGroup(), 2).step(
        parts, range(2), 0
    )

    assert counts[1] > 0
    assert float(found.terms["agent_type"].count) == counts[0]
    assert float(found.terms["position"].weight) == counts[0]


def test_a_parameter_that_no_scene_reaches_has_no_gradient_but_zero(setup, books):
    how = replace(setup.train, map_weight=0.0)
    training = begin(setup, *books)
    recipe = setup.recipe(ProcessGroup())

    OptimizerStep(training, how, ProcessGroup(), 1).step(recipe[0], recipe.own, 0)

    unreached = training.network.roads.next_token[0].weight
    assert not unreached.grad.any()
    assert sum(bool(p.grad.any()) for p in training.network.parameters()) > 100
