"""What a batch supervises is known before anything is computed."""

from dataclasses import replace

import pytest
import torch

from infgen.config import TrainSettings
from infgen.model.batching.batch import collate
from infgen.model.batching.supervision import (
    TERMS,
    Supervision,
    motion_mask,
    pattern_mask,
    stay_mask,
)
from infgen.model.device.packed import PackedBatch
from infgen.model.training.losses import losses

HOW = TrainSettings(first_motion_weight=3.0)
VARIANTS = {
    "whole": {},
    "patterns": {"validity_pattern_tokens": True},
    "motion only": {"insertion_and_removal": False},
    "regressed": {"position_token": False, "heading_token": False},
    "nobody leaves": {"remove_token": False},
}


def weights(scenes, limits):
    return Supervision.of(collate(scenes, limits, 0)).weight(HOW)


@pytest.mark.parametrize("changes", VARIANTS.values(), ids=VARIANTS)
def test_weights_are_those_the_losses_divide_by(record, limits, new_network, tiny, changes):
    scenes = [record(seed, agents=6 + seed, tokens=5 + seed) for seed in range(4)]
    batch = collate(scenes, limits, 0)
    network = new_network(replace(tiny, **changes))

    known = dict(zip(TERMS, Supervision.of(batch).weight(HOW).tolist(), strict=True))

    with torch.no_grad():
        terms = losses(network(batch, hidden_roads=True), batch, HOW)
    found = {name: float(term.weight) for name, term in terms.items()}
    assert found == pytest.approx({name: known[name] for name in terms})
    assert sum(found.values()) > 0


def test_weights_of_parts_add_up_to_those_of_the_whole(record, limits):
    scenes = [record(seed, agents=4 + 3 * seed, tokens=4 + seed) for seed in range(4)]

    parts = sum(weights(scenes[at::2], limits) for at in (0, 1))

    torch.testing.assert_close(parts, weights(scenes, limits))


def test_a_packed_batch_says_what_it_supervises(record, limits):
    batch = collate([record(seed, agents=6) for seed in range(2)], limits, 0)

    found = PackedBatch.of(batch).unpack(torch.device("cpu"))

    assert found.supervision is not None
    torch.testing.assert_close(
        found.supervision.weight(HOW), Supervision.of(batch).weight(HOW)
    )
    masks, agents = found.supervision.masks, batch.agents
    assert torch.equal(masks.motion, motion_mask(agents))
    assert torch.equal(masks.stay, stay_mask(agents))
    assert torch.equal(masks.pattern, pattern_mask(agents))
