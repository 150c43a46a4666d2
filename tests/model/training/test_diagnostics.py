"""Perplexity and reliability of decisions, against numbers known by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.training.diagnostics import (
    BIN_EDGES,
    decisions,
    motion_surprise,
    reliability,
)
from infgen.model.training.losses import losses


def test_decisions_are_sorted_by_their_probability():
    probability = torch.tensor([0.0, 0.0005, 0.02, 0.1, 0.15, 1.0])
    happened = torch.tensor([False, True, False, False, True, True])

    count, predicted, happens = reliability(probability, happened).tolist()

    assert count == [2, 0, 0, 1, 0, 2, 0, 0, 0, 1]
    assert predicted == pytest.approx([0.0005, 0, 0, 0.02, 0, 0.25, 0, 0, 0, 1])
    assert happens == [1, 0, 0, 0, 0, 1, 0, 0, 0, 1]


@given(st.lists(st.floats(0, 1, width=32), max_size=30))
def test_every_decision_is_in_the_bin_that_holds_it(values):
    probability = torch.tensor(values, dtype=torch.float32)

    count, predicted, happened = reliability(probability, probability > 0.5).numpy()

    assert count.sum() == len(values)
    assert happened.sum() == sum(value > 0.5 for value in values)
    mean = predicted[count > 0] / count[count > 0]
    low, high = np.array(BIN_EDGES[:-1]), np.array(BIN_EDGES[1:])
    assert (mean >= low[count > 0] - 1e-6).all()
    assert (mean <= high[count > 0] + 1e-6).all()


@pytest.fixture
def passed(record, limits, network):
    batch = collate([record(seed, agents=8, tokens=7) for seed in range(3)], limits, 0)
    with torch.no_grad():
        return network(batch), batch


def test_decisions_are_those_the_losses_count(passed):
    outputs, batch = passed
    terms = losses(outputs, batch, TrainSettings())

    found = decisions(outputs, batch)

    assert set(found) == {"keep", "add"}
    for name, (probability, happened) in found.items():
        assert len(probability) == float(terms[name].count) > 0
        assert float(probability.sum()) == pytest.approx(float(terms[name].right))
        assert float(happened.sum()) == float(terms[name].event) > 0


def test_surprise_is_the_unsmoothed_unweighted_loss_of_moves(passed):
    outputs, batch = passed
    plain = TrainSettings(label_smoothing=0.0, first_motion_weight=1.0)
    motion = losses(outputs, batch, plain)["motion"]

    nats, count = motion_surprise(outputs, batch).tolist()

    assert nats == pytest.approx(float(motion.loss), rel=1e-5)
    assert count == float(motion.count)
