"""What is learned from rollouts: likelier good choices, near to the pretrained network.

The policy term is minus the sum of advantage times log-probability (Williams 1992) over all
choices of the rollout (``choices``); the divergence is that from the network to the
pretrained one, summed over the same choices (``divergence``). The policy term has the
log-probability of no conflict beside it (``conflicts``). Both terms are divided by the
number of motion tokens, so ``divergence_weight`` is in rewards per nat.

Where the network has been trained since the rollouts were simulated, a choice counts by the
ratio of its probability to what it was then, and no further than ``CLIP`` from one in the
direction of its advantage (PPO: Schulman et al. 2017). Conflicts need no ratio: what was
sampled says only in which state the agent was.
"""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from infgen.model.logits import Outputs
from infgen.model.training.losses import Term, Terms
from infgen.model.training.policy_gradient.choices import choices_made
from infgen.model.training.policy_gradient.conflicts import Conflicts
from infgen.model.training.policy_gradient.divergence import divergence
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson

LEAST_ODDS = 1e-3
"""Where no conflict is less likely than this, little is learned any more."""
CLIP = 0.2
"""How far the probability of a choice, beside what it was, is changed by its advantage."""


def policy_terms(
    outputs: Outputs,
    pretrained: Outputs,
    lesson: PolicyLesson,
    stationary: Bool[Tensor, "3 motion_token"],
    top_p: float,
    conflict_penalty: float,
) -> Terms:
    """Compute the terms ``policy`` and ``divergence``.

    Args:
        outputs: Of the network, in evaluation mode.
        pretrained: The same of the pretrained network.
        lesson: The rollouts.
        stationary: Motion tokens that stand still, by agent type.
        top_p: Share of the probability that motion tokens were sampled from.
        conflict_penalty: Cost of a nat of the log-probability of no conflict.
    """
    count = lesson.moved.sum().float()
    gained = _gain(outputs, lesson, stationary, top_p)
    gained = gained + conflict_penalty * _safe_gain(outputs, lesson.conflicts)
    nothing = gained.new_zeros(())

    def term(loss: Tensor) -> Term:
        return Term(loss, count, count, nothing, nothing)

    return {
        "policy": term(-gained),
        "divergence": term(divergence(outputs, pretrained, lesson)),
    }


def _gain(
    outputs: Outputs, lesson: PolicyLesson, stationary: Tensor, top_p: float
) -> Tensor:
    """What is gained by making good choices likelier, summed."""
    made = choices_made(outputs, lesson, stationary, top_p)
    if lesson.log_probability is None:
        return (made.advantage * made.log_probability).sum()
    ratio = (made.log_probability - lesson.log_probability).exp()
    near = ratio.clamp(1 - CLIP, 1 + CLIP)
    return torch.minimum(made.advantage * ratio, made.advantage * near).sum()


def _safe_gain(outputs: Outputs, conflicts: Conflicts) -> Tensor:
    """Log-probabilities of no conflict, where there was one, summed."""
    scene, token, agent = conflicts.at.T
    row = outputs.motion.rows.number[scene, token - 1, agent]
    likely = outputs.motion.motion_logits[row].log_softmax(dim=-1)
    counts = conflicts.in_conflict * math.log(LEAST_ODDS)
    return (likely + counts).logsumexp(dim=-1).sum()
