"""What is learned from rollouts: likelier good choices, near to the pretrained network.

The policy term is minus the sum of advantage times log-probability (Williams 1992) over all
choices of the rollout (``choices``); the divergence is that from the network to the
pretrained one, summed over the same choices (``divergence``). The policy term has the
log-probability of no conflict beside it (``conflicts``), and that of no overlap of inserted
agents (``insertion_overlaps``). Both terms are divided by the number of motion tokens, so
``divergence_weight`` is in rewards per nat.

Where the network has been trained since the rollouts were simulated, a choice counts by the
ratio of its probability to what it was then, and no further than ``CLIP`` from one in the
direction of its advantage (PPO: Schulman et al. 2017). Conflicts and insertion overlaps
need no ratio: what was sampled says only in which state the agent was.
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
from infgen.model.training_settings import TrainSettings

LEAST_ODDS = 1e-3
"""Where no conflict (no overlap) is less likely than this, little is learned any more."""
CLIP = 0.2
"""How far the probability of a choice, beside what it was, is changed by its advantage."""


def policy_terms(
    outputs: Outputs,
    pretrained: Outputs,
    lesson: PolicyLesson,
    stationary: Bool[Tensor, "3 motion_token"],
    settings: TrainSettings,
) -> Terms:
    """Compute the terms ``policy`` and ``divergence``.

    Args:
        outputs: Of the network, in evaluation mode.
        pretrained: The same of the pretrained network.
        lesson: The rollouts.
        stationary: Motion tokens that stand still, by agent type.
        settings: How motion tokens were sampled, and what conflicts and overlaps cost.
    """
    count = lesson.moved.sum().float()
    gained = _gain(outputs, lesson, stationary, settings.policy_top_p)
    gained = gained + settings.conflict_penalty * _safe_gain(outputs, lesson.conflicts)
    free = _free_gain(outputs, lesson)
    gained = gained + settings.insertion_overlap_penalty * free
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
    return _log_avoids(outputs.motion.motion_logits[row], conflicts.in_conflict)


def _free_gain(outputs: Outputs, lesson: PolicyLesson) -> Tensor:
    """Log-probabilities of no overlap, of all choices of all insertions, summed."""
    overlaps = lesson.insertion_overlaps
    scene, place = overlaps.at.T
    gained = outputs.motion.motion_logits.new_zeros(())
    entries = outputs.entries
    if entries is not None and entries.position_logits is not None:
        details = lesson.batch.details
        token, turn = details.token[scene, place], details.turn[scene, place]
        row = entries.rows.number[scene, token]
        gained = gained + _log_avoids(entries.position_logits[row, turn], overlaps.cell)
    if outputs.details is not None:
        row = outputs.details.rows.number[scene, place]
        for logits, avoided in (
            (outputs.details.offset_logits, overlaps.offset),
            (outputs.details.heading_logits, overlaps.heading),
        ):
            if logits is not None:
                gained = gained + _log_avoids(logits[row], avoided)
    return gained


def _log_avoids(logits: Tensor, avoided: Bool[Tensor, "row choice"]) -> Tensor:
    """Log-probabilities of choices that are not to be avoided [row, choice], summed."""
    likely = logits.log_softmax(dim=-1) + avoided * math.log(LEAST_ODDS)
    return likely.logsumexp(dim=-1).sum()
