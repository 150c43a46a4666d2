"""Diagnostics besides the losses: perplexity, and calibration of control tokens."""

import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor
from torch.nn import functional

from infgen.model.batching.batch import Batch
from infgen.model.batching.supervision import motion_mask, stay_mask
from infgen.model.logits import Outputs
from infgen.model.training.losses import Chosen
from infgen.tokens.scene_tokens import Presence

BIN_EDGES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Bins of predicted probabilities, fine where agents leave: once in some twenty tokens."""


@torch.no_grad()
def motion_surprise(
    outputs: Outputs, batch: Batch, mask: Tensor | None = None
) -> Float32[Tensor, "2"]:
    """Sum the negative log-likelihoods of the next motion tokens, and count them.

    Without label smoothing and weights: the exponential of their mean is the perplexity.
    ``mask`` is ``motion_mask`` of the batch's agents, if it is known already.
    """
    rows, agents = outputs.motion.rows, batch.agents
    chosen = Chosen.of(rows.pack(motion_mask(agents) if mask is None else mask))
    target = chosen.take(rows.pack(agents.label.roll(-1, dims=1)))
    if chosen.counted is not None:
        target = target.clamp(min=0)  # Of rows that do not count.
    logits = chosen.take(outputs.motion.motion_logits)
    each = functional.cross_entropy(logits, target, reduction="none")
    return torch.stack([chosen.sum(each), chosen.count(each)])


@torch.no_grad()
def decisions(outputs: Outputs, batch: Batch) -> dict[str, tuple[Tensor, Tensor]]:
    """Gather the decisions to leave and to add: probability, and whether it happened.

    Returns:
        Both [decision] by the name of the loss term, of those the network has a head for.
    """
    found = {}
    rows, remove_logit = outputs.motion.rows, outputs.motion.remove_logit
    if remove_logit is not None:
        mask = rows.pack(stay_mask(batch.agents))
        leaves = rows.pack(batch.agents.presence.roll(-1, dims=1) == int(Presence.REMOVED))
        found["keep"] = (remove_logit[mask].sigmoid(), leaves[mask])
    if outputs.entries is not None:
        asked, add_logit = outputs.entries.rows, outputs.entries.add_logit
        agent = asked.pack(batch.entries.agent)
        slot = torch.arange(agent.shape[1], device=agent.device)
        decided = slot <= asked.pack(batch.entries.count)[:, None]
        found["add"] = (add_logit[decided].sigmoid(), (agent >= 0)[decided])
    return found


def reliability(
    probability: Float32[Tensor, " decision"], happened: Bool[Tensor, " decision"]
) -> Float64[Tensor, "3 bin"]:
    """Sort decisions into ``BIN_EDGES`` by their probability.

    Returns:
        Per bin: how many there are, the sum of their probabilities, how many happened.
    """
    edges = torch.tensor(BIN_EDGES[1:-1], device=probability.device)
    at = torch.bucketize(probability, edges, right=True)
    found = torch.zeros((3, len(BIN_EDGES) - 1), dtype=torch.float64, device=at.device)
    each = torch.stack([torch.ones_like(probability), probability, happened.float()])
    return found.index_add_(1, at, each.double())
