"""Checkpoints hold all there is, and a kill leaves the old one or the new one."""

from dataclasses import replace

import torch

from pipeline.stages.train.loop import train
from pipeline.stages.train.setup import begin
from pipeline.storage.checkpoint import load_checkpoint, save_checkpoint
from pipeline.storage.weights import state_dict_of


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(setup, books):
    training = begin(setup, *books)
    save_checkpoint(setup.folder, training, 2)
    half = setup.folder / "checkpoint-000000004"
    half.mkdir()
    (half / "network.safetensors").write_bytes(b"half")
    before = {
        name: value.clone() for name, value in state_dict_of(training.network).items()
    }
    for parameter in training.network.parameters():
        parameter.data += 1

    assert load_checkpoint(setup.folder, training) == 2

    after = state_dict_of(training.network)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    save_checkpoint(setup.folder, training, 4)
    assert [p.name for p in setup.folder.glob("checkpoint-*")] == [half.name]


def test_a_checkpoint_holds_the_optimiser_and_the_average(setup, books, quiet):
    training = begin(setup, *books)
    train(replace(setup, train=replace(setup.train, steps=2)), training, quiet)
    other = begin(setup, *books)

    assert load_checkpoint(setup.folder, other) == 2

    for name, value in training.average.items():
        assert torch.equal(other.average[name], value)
    pairs = zip(training.network.parameters(), other.network.parameters(), strict=True)
    for one, two in pairs:
        state, restored = training.optimiser.state[one], other.optimiser.state[two]
        assert state.keys() == restored.keys()
        assert all(torch.equal(state[what], restored[what]) for what in state)
