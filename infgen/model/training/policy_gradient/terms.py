"""What is learned from rollouts: likelier good choices, near to the pretrained network.

The policy term is minus the sum of advantage times log-probability (Williams 1992) over all
choices of the rollout (``choices``); the divergence is that from the network to the
pretrained one, summed over the same choices (``divergence``). Both terms are divided by the
number of motion tokens, so ``divergence_weight`` is in rewards per nat.

The policy term has what is to be avoided beside it (``avoided``): motion tokens in
conflict, off the road and slowly on, and places onto other agents. There the network learns
what the pretrained one would sample of all other choices: minus the divergence of its own
from the pretrained distribution without what is to be avoided. Of what is avoided nothing
else is learned than to take another, and the odds of all others beside each other stay as
they were. At first that is the log-probability of all others; their expected number would
not do, as mostly all the likely choices are to be avoided, and it hardly changes with their
odds.

Where the network has been trained since the rollouts were simulated, a choice counts by the
ratio of its probability to what it was then, and no further than ``CLIP`` from one in the
direction of its advantage (PPO: Schulman et al. 2017). What is to be avoided needs no
ratio: what was sampled says only in which state the agent was.
"""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from infgen.model.attention.neighbour_attention import HIDDEN_SCORE
from infgen.model.logits import Outputs
from infgen.model.training.losses import Term, Terms
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.choices import choices_made
from infgen.model.training.policy_gradient.divergence import divergence
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson
from infgen.model.training_settings import TrainSettings

LEAST_ODDS = 1e-3
"""Factor on the pretrained probabilities of choices to be avoided. Where all others are
less likely than this, little is learned any more."""
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
        settings: How motion tokens were sampled, and what is to be avoided costs.
    """
    count = lesson.moved.sum().float()
    gained = _gain(outputs, lesson, stationary, settings.policy_top_p)
    both = outputs, pretrained
    for penalty, tokens in (
        (settings.conflict_penalty, lesson.conflicts),
        (settings.departure_penalty, lesson.departures),
        (settings.creeping_penalty, lesson.creeping),
    ):
        gained = gained - penalty * tokens.excess * _from_other_tokens(*both, tokens)
    overlap = _from_other_places(*both, lesson)
    gained = gained - settings.insertion_overlap_penalty * overlap
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


def _from_other_tokens(
    outputs: Outputs, pretrained: Outputs, tokens: AvoidedTokens
) -> Tensor:
    """Divergences from motion tokens that are not to be avoided, summed."""
    scene, token, agent = tokens.at.T
    row = outputs.motion.rows.number[scene, token - 1, agent]
    own, theirs = outputs.motion.motion_logits, pretrained.motion.motion_logits
    return _from_others(own[row], theirs[row], tokens.avoided)


def _from_other_places(
    outputs: Outputs, pretrained: Outputs, lesson: PolicyLesson
) -> Tensor:
    """Divergences from places without overlap, of all choices of insertions, summed."""
    overlaps, details = lesson.insertion_overlaps, lesson.batch.details
    scene, place = overlaps.at.T
    found = outputs.motion.motion_logits.new_zeros(())
    one, other = outputs.entries, pretrained.entries
    if one is not None and other is not None:
        token, turn = details.token[scene, place], details.turn[scene, place]
        at = one.rows.number[scene, token], turn
        if one.position_logits is not None and other.position_logits is not None:
            own, theirs = (
                logits[at].masked_fill(~overlaps.near, HIDDEN_SCORE)
                for logits in (one.position_logits, other.position_logits)
            )
            found = found + _from_others(own, theirs, overlaps.cell)
    if outputs.details is not None and pretrained.details is not None:
        detail, their_detail = outputs.details, pretrained.details
        row = detail.rows.number[scene, place]
        for choice, others, avoided in (
            (detail.offset_logits, their_detail.offset_logits, overlaps.offset),
            (detail.heading_logits, their_detail.heading_logits, overlaps.heading),
        ):
            if choice is not None and others is not None:
                found = found + _from_others(choice[row], others[row], avoided)
    return found


def _from_others(logits: Tensor, others: Tensor, avoided: Tensor) -> Tensor:
    """Sum the divergences from pretrained choices that are not to be avoided.

    Args:
        logits: Of the network [row, choice].
        others: Of the pretrained network [row, choice].
        avoided: Choices to be avoided [row, choice].
    """
    wanted = (others + avoided * math.log(LEAST_ODDS)).log_softmax(dim=-1)
    return (wanted.exp() * (wanted - logits.log_softmax(dim=-1))).sum()
