"""How much of a batch is supervised: the weights that each term of the loss divides by.

A function of the batch alone. So a step that is cut into parts, and spread over processes,
can divide every part by the weights of the whole before any of it is computed.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.training.losses import OF_ROLLOUTS, AgentMasks
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


@dataclass(frozen=True, slots=True)
class Supervision:
    """What is supervised of a batch: of the batch alone, so loaders may find it.

    Attributes:
        masks: Of agents.
        count: How many tokens every term supervises [term]; then how many of the motion
            tokens are the first ones of inserted agents.
    """

    masks: AgentMasks
    count: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, batch: Batch) -> "Supervision":
        """Find it."""
        masks = AgentMasks.of(batch.agents)
        return cls(masks, _counts(batch, masks))

    def weight(self, settings: TrainSettings) -> Tensor:
        """Sum the weights of every term [term], as ``losses`` does."""
        weight = self.count[: len(TERMS)].clone()
        # Motion comes first; the first motion token of an inserted agent counts more.
        weight[:1].add_(self.count[-1], alpha=settings.first_motion_weight - 1)
        return weight


def supervised(batch: Batch, settings: TrainSettings) -> Tensor:
    """Sum the weights of every term [term] over a batch, as ``losses`` does.

    Terms that the network has no head for are counted all the same.
    """
    return Supervision.of(batch).weight(settings)


def _counts(batch: Batch, masks: AgentMasks) -> Tensor:
    details, entries = batch.details, batch.entries
    num_inserted = (entries.agent >= 0).sum()
    described = details.present.sum()
    real = (details.present & details.inserted).sum()
    first = batch.agents.presence == int(Presence.INSERTED)
    first[:, 0] = False
    count = {
        "motion": masks.motion.sum(),
        "keep": masks.stay.sum(),
        "validity_pattern": masks.pattern.sum(),
        "add": _decided(batch),
        **dict.fromkeys(("position", "position_regression"), num_inserted),
        **dict.fromkeys(("agent_type", "size"), real),
        **dict.fromkeys(("heading", "heading_regression", "offset"), described),
        "map": batch.roads.predicted.sum(),
        **dict.fromkeys(OF_ROLLOUTS, num_inserted.new_zeros(())),
    }
    found = [*(count[name] for name in TERMS), (masks.motion & first).sum()]
    return torch.stack(found).float()


def supervised_choices(count: Tensor) -> Tensor:
    """The same [term] of simulated rollouts, of the number of motion tokens chosen."""
    nothing = torch.zeros_like(count)
    weights = [count if name in OF_ROLLOUTS else nothing for name in TERMS]
    return torch.stack(weights).float()


def _decided(batch: Batch) -> Tensor:
    """Count decisions of ADD: one per inserted agent, and BEGIN MOTION at the end."""
    entries = batch.entries
    slots = entries.agent.shape[2]
    return torch.where(entries.asked, (entries.count + 1).clamp(max=slots), 0).sum()
