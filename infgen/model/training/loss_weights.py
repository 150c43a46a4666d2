"""How much of a batch is supervised: the weights that each term of the loss divides by.

A function of the batch alone. So a step that is cut into parts, and spread over processes,
can divide every part by the weights of the whole before any of it is computed.
"""

import torch
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.training.losses import OF_ROLLOUTS, motion_mask, pattern_mask, stay_mask
from infgen.model.training_settings import TrainSettings
from infgen.tokens.scene_tokens import Presence

TERMS = (
    *("motion", "keep", "validity_pattern"),
    *("add", "position", "position_regression"),
    *("agent_type", "size", "heading", "heading_regression", "offset"),
    "map",
    *OF_ROLLOUTS,
)
"""Every term that a network may have, in this order."""


def supervised(batch: Batch, settings: TrainSettings) -> Tensor:
    """Sum the weights of every term [term] over a batch, as ``losses`` does.

    Terms that the network has no head for are counted all the same.
    """
    details, entries = batch.details, batch.entries
    num_inserted = (entries.agent >= 0).sum()
    described = details.present.sum()
    real = (details.present & details.inserted).sum()
    weight = {
        "motion": _motion(batch, settings),
        "keep": stay_mask(batch.agents).sum(),
        "validity_pattern": pattern_mask(batch.agents).sum(),
        "add": _decided(batch),
        **dict.fromkeys(("position", "position_regression"), num_inserted),
        **dict.fromkeys(("agent_type", "size"), real),
        **dict.fromkeys(("heading", "heading_regression", "offset"), described),
        "map": batch.roads.predicted.sum(),
        **dict.fromkeys(OF_ROLLOUTS, num_inserted.new_zeros(())),
    }
    return torch.stack([weight[name].float() for name in TERMS])


def supervised_choices(count: Tensor) -> Tensor:
    """The same [term] of simulated rollouts, of the number of motion tokens chosen."""
    nothing = torch.zeros_like(count)
    weights = [count if name in OF_ROLLOUTS else nothing for name in TERMS]
    return torch.stack(weights).float()


def _motion(batch: Batch, settings: TrainSettings) -> Tensor:
    """Weights of motion tokens; the first one of an inserted agent counts more."""
    mask = motion_mask(batch.agents)
    first = batch.agents.presence == int(Presence.INSERTED)
    first[:, 0] = False
    return mask.sum() + (settings.first_motion_weight - 1) * (mask & first).sum()


def _decided(batch: Batch) -> Tensor:
    """Count decisions of ADD: one per inserted agent, and BEGIN MOTION at the end."""
    entries = batch.entries
    slots = entries.agent.shape[2]
    return torch.where(entries.asked, (entries.count + 1).clamp(max=slots), 0).sum()
