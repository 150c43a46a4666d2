"""The loop: what it says no to, what it keeps when it must stop, and that it learns."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import torch

from pipeline.stages.train.loader import TokenScenes, train_batches
from pipeline.stages.train.loop import train
from pipeline.stages.train.setup import TrainingError, begin
from pipeline.stages.train.train_log import TrainLog, read_log
from pipeline.storage.checkpoint import load_checkpoint


@pytest.fixture
def spoilt(monkeypatch):
    """``spoilt(step, part)``: agents of that part have no size that is a number."""

    def spoil(step, part=0):
        def batches(*arguments):
            for number, parts in enumerate(train_batches(*arguments)):
                if number == step:
                    agents = parts[part].agents
                    size = agents.size_lwh_m * torch.nan
                    broken = replace(agents, size_lwh_m=size)
                    parts[part] = replace(parts[part], agents=broken)
                yield parts

        monkeypatch.setattr("pipeline.stages.train.loop.train_batches", batches)

    return spoil


def test_a_loss_that_is_not_finite_names_its_terms_and_scenes_and_keeps_the_weights(
    setup, books, quiet, spoilt
):
    training = begin(setup, *books)
    spoilt(step=3)

    with pytest.raises(
        TrainingError, match=r"step 3: .*\(motion, .*training-\d, training-\d"
    ):
        train(setup, training, quiet)

    other = begin(setup, *books)
    assert load_checkpoint(setup.folder, other) == 3
    assert all(torch.isfinite(p).all() for p in other.network.parameters())


def test_memory_that_does_not_suffice_is_an_error_that_names_the_settings(
    setup, books, quiet
):
    training, forwards = begin(setup, *books), count(1)

    def full(module, arguments):
        if next(forwards) > 3:
            raise torch.OutOfMemoryError("tried to allocate 7 GiB\nand more")

    training.network.register_forward_pre_hook(full)

    with pytest.raises(TrainingError, match=r"step 3: .* 2 scenes .*gradient_accumulation"):
        train(setup, training, quiet)

    other = begin(setup, *books)
    assert load_checkpoint(setup.folder, other) == 3
    for name, value in other.network.state_dict().items():
        assert torch.equal(training.network.state_dict()[name], value)


def test_only_the_scenes_of_the_part_that_is_not_finite_are_named(
    setup, books, quiet, spoilt
):
    setup = replace(setup, train=replace(setup.train, gradient_accumulation=2, steps=1))
    spoilt(step=0, part=1)

    with pytest.raises(TrainingError, match=r"its scenes: training-\d$"):
        train(setup, begin(setup, *books), quiet)


def test_noise_is_learned_from_if_it_is_asked_for(setup, books, quiet, monkeypatch):
    given = []

    def batches(recipe, *others):
        given.append(recipe.noise)
        return train_batches(recipe, *others)

    monkeypatch.setattr("pipeline.stages.train.loop.train_batches", batches)
    how = replace(setup.train, steps=1, motion_noise_neighbours=3)

    train(replace(setup, train=how), begin(setup, *books), quiet)

    assert given[0].moves == 3
    assert given[0].table.vocabulary.num_motion_tokens == books[0].num_motion_tokens


def test_no_scenes_to_train_on_is_said(setup, books, quiet):
    empty = replace(setup, scenes=TokenScenes([]))

    with pytest.raises(TrainingError, match="no scenes of split 'training'"):
        train(empty, begin(setup, *books), quiet)


def test_who_does_no_steps_needs_no_scenes_to_train_on(setup, books, quiet):
    idle = replace(setup, scenes=TokenScenes([]), train=replace(setup.train, steps=0))

    found = train(idle, begin(idle, *books), quiet)

    assert found.validation


def test_without_held_out_scenes_there_is_no_validation(setup, books, quiet):
    found = train(replace(setup, validation_split=[]), begin(setup, *books), quiet)

    assert found.validation == {}


def test_the_loss_goes_down(setup, books, quiet):
    how = replace(setup.train, steps=30, learning_rate=1e-2, label_smoothing=0.0)
    longer = replace(
        setup, train=replace(how, checkpoint_every_steps=0, validate_every_steps=0)
    )

    train(longer, begin(longer, *books), quiet)

    lines = read_log(setup.folder / "train.jsonl")[:-1]
    motion = [line["motion"] for line in lines]
    assert len(motion) == 30
    assert np.mean(motion[-5:]) < 0.7 * np.mean(motion[:5])
    assert lines[-1]["motion_perplexity"] < lines[0]["motion_perplexity"]


def test_only_the_named_parts_are_trained(setup, books, quiet):
    how = replace(setup.train, trained_parts="cells, details.heading")
    some = replace(setup, train=how)
    before = dict(begin(some, *books).network.named_parameters())
    training = begin(some, *books)

    train(some, training, quiet)

    changed = {
        name
        for name, parameter in training.network.named_parameters()
        if not torch.equal(parameter, before[name])
    }
    assert changed
    assert {name.split(".")[0] for name in changed} == {"cells", "details"}
    assert all(name.startswith(("cells", "details.heading")) for name in changed)


def test_parts_that_there_are_not_are_named(setup, books):
    some = replace(setup, train=replace(setup.train, trained_parts="wheels"))

    with pytest.raises(TrainingError, match=r"'wheels'; names begin with .*details"):
        begin(some, *books)


def test_a_log_forgets_what_lies_beyond_the_checkpoint(tmp_path):
    path = tmp_path / "train.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"ste')

    log = TrainLog(path, first=2)
    log.add({"step": 3, "motion": 1.0})
    assert [line["step"] for line in read_log(path)] == [1, 2]
    log.flush()

    assert read_log(path)[-1] == {"step": 3, "motion": 1.0}
