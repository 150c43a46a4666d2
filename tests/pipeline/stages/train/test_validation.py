"""What is said of weights on scenes they were not trained on."""

from dataclasses import replace

import pytest

from infgen.model.training.diagnostics import BIN_EDGES
from pipeline.stages.train.loop import train
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.setup import begin
from pipeline.stages.train.train_log import read_log
from pipeline.stages.train.validation import validate


@pytest.fixture
def found(setup, books):
    training = begin(setup, *books)
    return validate(setup, training, Pass(training.network, setup.train))


@pytest.mark.parametrize("name", ["keep", "add"])
def test_reliability_bins_add_up_to_the_overall_rates(found, name):
    bins = found[f"{name}_bins"]

    assert bins["edges"] == list(BIN_EDGES)
    assert {len(bins[k]) for k in ("count", "predicted", "happened")} == {10}
    count = found[f"{name}_count"]
    assert sum(bins["count"]) == count > 0
    assert sum(bins["predicted"]) / count == pytest.approx(found[f"{name}_predicted"])
    assert sum(bins["happened"]) / count == pytest.approx(found[f"{name}_logged"])


def test_fresh_weights_are_about_as_perplexed_as_there_are_moves(found, metre_moves):
    assert 0.5 < found["motion_perplexity"] / metre_moves.num_motion_tokens < 2.5


def test_smaller_parts_find_the_same(setup, books, found):
    alone = replace(setup, train=replace(setup.train, gradient_accumulation=2))
    training = begin(alone, *books)

    again = validate(alone, training, Pass(training.network, alone.train))

    for name, value in found.items():
        if isinstance(value, float):
            assert again[name] == pytest.approx(value, rel=1e-4), name


def test_the_log_holds_all_of_it(setup, books, quiet):
    trained = train(setup, begin(setup, *books), quiet)

    lines = read_log(setup.folder / "train.jsonl")
    assert lines[-1] == {"step": 6, "validation": trained.validation}


@pytest.mark.parametrize("population", [False, True])
def test_scenes_are_played_before_they_are_learned_from(setup, books, quiet, population):
    how = replace(
        setup.train,
        steps=2,
        closed_loop_top_k=4,
        closed_loop_population=population,
        checkpoint_every_steps=0,
    )
    played = replace(setup, train=how)

    train(played, begin(played, *books), quiet)

    lines = read_log(setup.folder / "train.jsonl")
    assert lines[0]["motion_count"] > 0
    assert lines[0]["motion"] < 10
