"""Training by policy gradient: what it notes, what it starts from, that it resumes."""

import signal
from dataclasses import replace

import pytest
import torch

from infgen.config import TrainSettings
from infgen.errors import ConfigError
from infgen.model.network import Network
from pipeline.engine.signals import Stopped
from pipeline.stages.train.lessons import prepare_lessons
from pipeline.stages.train.loop import train
from pipeline.stages.train.optimizer_step import NotFiniteError, OptimizerStep
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import begin
from pipeline.stages.train.stage import reads
from pipeline.stages.train.train_log import read_log
from pipeline.stages.train.updates import cut_into_updates
from pipeline.storage.checkpoint import load_checkpoint
from pipeline.storage.weights import save_network, state_dict_of

CPU = torch.device("cpu")
HOW = {
    "policy_gradient_rollouts": 3,
    "max_token_steps": 6,
    "steps": 3,
    "checkpoint_every_steps": 0,
    "validate_every_steps": 0,
    "validation_scenes": 0,
}


@pytest.fixture
def tuned(setup, books, tmp_path):
    """``tuned(folder, **changes)``: fine-tuning of weights that lie in a folder."""
    pretrained = tmp_path / "pretrained"
    pretrained.mkdir()
    network = begin(setup, *books).network
    save_network(pretrained, network, state_dict_of(network), 0)

    def tune(folder, **changes):
        target = tmp_path / folder
        target.mkdir()
        how = replace(setup.train, **{**HOW, **changes})
        return replace(setup, train=how, folder=target, start=pretrained)

    return tune


def lines_of(setup, books, quiet):
    train(setup, begin(setup, *books), quiet)
    return [
        line for line in read_log(setup.folder / "train.jsonl") if "validation" not in line
    ]


def test_the_log_tells_rewards_and_the_divergence_which_begins_at_zero(tuned, books, quiet):
    lines = lines_of(tuned("run"), books, quiet)

    assert len(lines) == 3
    assert lines[0]["divergence"] == pytest.approx(0, abs=1e-6)  # Of rounding.
    assert lines[-1]["divergence"] > 0
    for line in lines:
        assert line["policy_count"] == line["divergence_count"] > 0
        assert {"policy", "rollout_reward", "rollout_overlapping_agents"} <= set(line)
        assert "motion" not in line
        assert "motion_perplexity" not in line
        assert line["total"] == pytest.approx(line["policy"] + 0.1 * line["divergence"])


def test_the_log_can_be_learned_from_besides(tuned, books, quiet):
    lines = lines_of(tuned("run", log_weight=0.5, steps=1), books, quiet)

    assert lines[0]["motion_count"] > 0
    assert lines[0]["motion_perplexity"] > 1
    assert lines[0]["total"] > 0.4 * lines[0]["motion"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "updates",
    [{}, {"policy_minibatches": 3, "policy_epochs": 2, "trained_parts": "motion"}],
)
def test_a_run_that_is_stopped_goes_on_to_the_same_bits(
    tuned, books, quiet, monkeypatch, updates
):
    monkeypatch.setattr("pipeline.stages.train.throughput.TELL_EVERY_S", 0.0)

    def stop(done, total, note=""):
        if done == 1:
            raise Stopped(signal.SIGTERM)

    whole = tuned("whole", **updates, checkpoint_every_steps=1)
    cut = tuned("cut", **updates)
    one = begin(whole, *books)
    train(whole, one, quiet)
    with pytest.raises(Stopped):
        train(cut, begin(cut, *books), stop)
    other = begin(cut, *books)
    assert load_checkpoint(cut.folder, other) == 1
    train(cut, other, quiet)

    pairs = zip(one.network.parameters(), other.network.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    pairs = zip(one.pretrained.parameters(), other.pretrained.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    logs = [(each.folder / "train.jsonl").read_bytes() for each in (whole, cut)]
    assert logs[0] == logs[1]


def test_the_pretrained_network_is_that_of_the_initial_weights_and_never_changes(
    tuned, books, quiet
):
    setup = tuned("run", learning_rate=1e-2)
    training = begin(setup, *books)
    before = [each.clone() for each in training.network.parameters()]

    train(setup, training, quiet)

    pretrained = list(training.pretrained.parameters())
    assert all(torch.equal(a, b) for a, b in zip(pretrained, before, strict=True))
    assert not any(each.requires_grad for each in pretrained)
    moved = training.network.parameters()
    assert not all(torch.equal(a, b) for a, b in zip(moved, before, strict=True))
    assert begin(replace(setup, train=TrainSettings()), *books).pretrained is None


def test_no_step_is_done_where_nothing_is_better_than_anything_else(tuned, books):
    setup = tuned(
        "run",
        overlap_penalty=0,
        placement_penalty=0,
        speed_penalty=0,
        ego_speed_penalty=0,
        agent_type_penalty=0,
        count_penalty=0,
        off_road_penalty=0,
        log_distance_penalty=0,
        weight_decay=0,
    )
    training, recipe = begin(setup, *books), setup.recipe(ProcessGroup())

    stepped = OptimizerStep(training, setup.train, ProcessGroup(), recipe.parts).step(
        recipe[0], recipe.own, 0
    )

    assert stepped.norm == pytest.approx(0, abs=1e-5)


def test_every_rollout_is_learned_from_once_an_epoch(tuned, books):
    how = {"policy_minibatches": 4, "policy_epochs": 3, "gradient_accumulation": 2}
    setup = tuned("run", batch_scenes=2, **how)
    training, recipe = begin(setup, *books), setup.recipe(ProcessGroup())
    forward = Pass(training.network, setup.train)
    lessons = [
        prepare_lessons(part, training.network, forward, setup.train, CPU, number)
        for number, part in enumerate(recipe[0])
    ]

    updates = list(cut_into_updates(lessons, setup.train, 5))

    assert len(updates) == 12
    every = sorted(id(x) for each in lessons for x in each.rollouts.lessons)
    orders = []
    for epoch in range(3):
        learned = [
            id(lesson)
            for update in updates[4 * epoch : 4 * epoch + 4]
            for part in update
            for lesson in part.rollouts.lessons
        ]
        assert sorted(learned) == every
        orders.append(tuple(learned))
    assert len(set(orders)) > 1
    sizes = [sum(len(part.rollouts.lessons) for part in each) for each in updates]
    assert set(sizes) == {1, 2}  # Six rollouts in four parts.


def test_several_updates_of_a_step_learn_more_than_one(tuned, books, quiet):
    found = []
    for folder, updates in (("one", {}), ("more", {"policy_epochs": 4})):
        setup = tuned(folder, steps=1, warmup_steps=0, learning_rate=1e-3, **updates)
        training = begin(setup, *books)
        train(setup, training, quiet)
        (line,) = read_log(setup.folder / "train.jsonl")[:1]
        pairs = zip(
            training.network.parameters(), training.pretrained.parameters(), strict=True
        )
        found.append((line, sum(float((a - b).detach().abs().sum()) for a, b in pairs)))

    (one, moved), (more, moved_more) = found
    assert moved_more > 2 * moved
    assert more["policy_count"] == 4 * one["policy_count"]
    assert more["rollout_entries"] == one["rollout_entries"]
    assert more["divergence"] > one["divergence"]


def test_a_step_that_fails_in_its_second_update_is_not_done_at_all(
    tuned, books, monkeypatch
):
    setup = tuned("run", policy_epochs=2, learning_rate=1e-2)
    training, recipe = begin(setup, *books), setup.recipe(ProcessGroup())
    stepper = OptimizerStep(training, setup.train, ProcessGroup(), recipe.parts)
    before = [each.clone() for each in training.network.parameters()]
    norms = []

    def fail(norm, terms, bad):
        norms.append(norm)
        if len(norms) == 2:
            raise NotFiniteError(["policy"], [0])

    monkeypatch.setattr("pipeline.stages.train.optimizer_step._check", fail)
    with pytest.raises(NotFiniteError):
        stepper.step(recipe[0], recipe.own, 0)
    undone = [each.clone() for each in training.network.parameters()]
    stepper.step(recipe[0], recipe.own, 0)

    assert all(torch.equal(a, b) for a, b in zip(undone, before, strict=True))
    after = training.network.parameters()
    assert not all(torch.equal(a, b) for a, b in zip(after, before, strict=True))
    assert norms[2:] == norms[:2]  # The same step again.


@pytest.mark.slow
def test_a_signal_between_two_updates_ends_the_step_and_the_run_goes_on_to_the_same_bits(
    tuned, books, quiet, monkeypatch
):
    whole, cut = (tuned(folder, steps=2, policy_epochs=2) for folder in ("whole", "cut"))
    one, other = begin(whole, *books), begin(cut, *books)
    train(whole, one, quiet)
    updates, update = [], OptimizerStep._update

    def watched(self, lessons, own, step):
        updates.append(step)
        return update(self, lessons, own, step)

    monkeypatch.setattr(OptimizerStep, "_update", watched)
    with monkeypatch.context() as asked:
        asked.setattr(
            "pipeline.engine.signals.pending_signal",
            lambda: signal.SIGTERM if len(updates) == 3 else 0,
        )
        with pytest.raises(Stopped):
            train(cut, other, quiet)
    assert updates == [0, 0, 1]
    other = begin(cut, *books)
    assert load_checkpoint(cut.folder, other) == 1
    train(cut, other, quiet)

    assert updates[3:] == [1, 1]
    pairs = zip(one.network.parameters(), other.network.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.slow
def test_insertions_are_left_out_where_only_the_motion_stack_is_trained(
    tuned, books, quiet, monkeypatch
):
    how = {"trained_parts": "motion", "count_penalty": 1.0, "agent_type_penalty": 1.0}
    left_out, asked = tuned("left-out", **how), tuned("asked", **how)
    calls = []

    def watched(network, batch, **given):
        calls.append(given.get("insertions", True))
        return forward(network, batch, **given)

    forward = Network.forward
    monkeypatch.setattr(Network, "forward", watched)
    one = begin(left_out, *books)
    train(left_out, one, quiet)
    assert False in calls
    assert len(set(calls)) == 1
    monkeypatch.setattr(
        "pipeline.stages.train.lessons._learns_of_insertions", lambda network: True
    )
    calls.clear()
    other = begin(asked, *books)
    train(asked, other, quiet)
    assert set(calls) == {True}

    pairs = zip(one.network.parameters(), other.network.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_fine_tuning_needs_weights_to_start_from(tmp_path):
    how = TrainSettings(policy_gradient_rollouts=4)

    with pytest.raises(ConfigError, match=r"rollouts is 4, but train\.initial_weights is"):
        reads(tmp_path, {"train": how})

    (source,) = reads(tmp_path, {"train": replace(how, initial_weights="builtin")})
    assert source.fingerprint
