"""Scenes that features are tested on."""

from dataclasses import replace

import pytest

from infgen.model.batching.batch import collate
from infgen.tokens.scene_tokens import Presence


@pytest.fixture
def batch(record, limits):
    return collate([record(3, tokens=9), record(4, agents=9)], limits, 7)


@pytest.fixture
def inserted_twice(batch):
    """Agent 1 is inserted at token step 4, in two batches: it was elsewhere before."""
    presence, pose = batch.agents.presence.clone(), batch.agents.pose.clone()
    presence[:, 4, 1] = int(Presence.INSERTED)
    inserted = replace(batch.agents, presence=presence)
    pose[:, 3, 1, :2] += 3.0
    return [
        replace(batch, agents=agents) for agents in (inserted, replace(inserted, pose=pose))
    ]
