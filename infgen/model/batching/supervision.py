"""What of a batch is supervised, and the weights that each term of the loss divides by.

A function of the batch alone. So a step that is cut into parts, and spread over processes,
can divide every part by the weights of the whole before any of it is computed.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from infgen.model.batching.batch import Agents, Batch
from infgen.model.training_settings import TrainSettings
from infgen.tokens.scene_tokens import Presence

OF_ROLLOUTS = ("policy", "divergence")
"""Terms of simulated rollouts (``policy_gradient``)."""
TERMS = (
    *("motion", "keep", "validity_pattern"),
    *("add", "position", "position_regression"),
    *("agent_type", "size", "heading", "heading_regression"),
    *("offset", "offset_token"),
    "map",
    *OF_ROLLOUTS,
)
"""Every term that a network may have, in this order."""


@dataclass(frozen=True, slots=True)
class AgentMasks:
    """Which tokens of agents are supervised; it follows from a batch alone.

    Attributes:
        motion: ``motion_mask`` [scene, token, agent].
        stay: ``stay_mask`` [scene, token, agent].
        pattern: ``pattern_mask`` [scene, token, agent].
    """

    motion: Tensor
    stay: Tensor
    pattern: Tensor

    @classmethod
    def of(cls, agents: Agents) -> "AgentMasks":
        """Find them."""
        return cls(motion_mask(agents), stay_mask(agents), pattern_mask(agents))


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
        **dict.fromkeys(("heading", "heading_regression"), described),
        **dict.fromkeys(("offset", "offset_token"), described),
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


def motion_mask(agents: Agents) -> Tensor:
    """Tell which tokens [scene, token, agent] have a supervised next one (SPEC 3.5).

    The next motion token must be known. An inserted agent's first one is always supervised.
    Later ones ask for the token before and the one itself to be observed, so that nothing
    is learned at the edges of a gap; entering counts as observed for the token that follows
    it.
    """
    entering = agents.presence == int(Presence.INSERTED)
    there = agents.observed
    known = following(agents.label, -1) >= 0
    mask = known & following(there, False)
    mask &= entering | (there & preceding(there | entering))
    return mask & agents.near[:, None]


def stay_mask(agents: Agents) -> Tensor:
    """Tell which tokens [scene, token, agent] decide between staying and leaving.

    All from entering to the last but one at which the agent is seen. Not the ego: it never
    leaves. Nor at a log's end, where who is lost for a moment does not come back.
    """
    return pattern_mask(agents) & following(agents.told, False)


def pattern_mask(agents: Agents) -> Tensor:
    """Tell which tokens [scene, token, agent] the agent goes on living after."""
    then = following(agents.presence, int(Presence.ABSENT))
    goes_on = (then == int(Presence.PRESENT)) | (then == int(Presence.REMOVED))
    return agents.visible & (agents.presence != int(Presence.REMOVED)) & goes_on


def following(values: Tensor, last: int | bool) -> Tensor:
    """Shift values [scene, token, ...] to the tokens that they are predicted from."""
    return torch.cat([values[:, 1:], torch.full_like(values[:, :1], last)], dim=1)


def preceding(values: Tensor) -> Tensor:
    """Shift values [scene, token, ...] to the next token; the first has none."""
    return torch.cat([torch.zeros_like(values[:, :1]), values[:, :-1]], dim=1)
