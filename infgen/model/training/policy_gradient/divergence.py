"""How far a network has come from the pretrained one, over all choices of rollouts.

Kullback-Leibler divergences of motion tokens, removals, insertions, and the cells, types,
headings and offset tokens of inserted agents. Sizes and regressed offsets, which are not
sampled, count as means of normal distributions of variance one.
"""

from torch import Tensor
from torch.nn.functional import logsigmoid

from infgen.model.batching.supervision import following
from infgen.model.logits import InsertionOutputs, Outputs
from infgen.model.training.policy_gradient.choices import (
    decided,
    insertion_rate,
    removal_rate,
)
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson


def divergence(outputs: Outputs, pretrained: Outputs, lesson: PolicyLesson) -> Tensor:
    """Sum the divergence from the pretrained network over all choices."""
    rows, entries = outputs.motion.rows, lesson.batch.entries
    moves = rows.pack(following(lesson.moved, False))
    one, other = outputs.motion, pretrained.motion
    found = _of_choice(one.motion_logits[moves], other.motion_logits[moves])
    if one.remove_logit is not None and other.remove_logit is not None:
        asked = rows.pack(following(lesson.removable, False))
        added = removal_rate(outputs, lesson)[asked]
        own, theirs = one.remove_logit[asked], other.remove_logit[asked]
        found = found + _of_event(own + added, theirs + added)
    if outputs.entries is not None and pretrained.entries is not None:
        turns = decided(outputs.entries, entries)
        added = insertion_rate(outputs.entries, lesson).expand(turns.shape)[turns]
        found = found + _of_insertions(outputs.entries, pretrained.entries, turns, added)
    return found + _of_details(outputs, pretrained)


def _of_insertions(
    one: InsertionOutputs, other: InsertionOutputs, turns: Tensor, added: Tensor
) -> Tensor:
    """Divergence of insertions, and of the cells of those that there were."""
    found = _of_event(one.add_logit[turns] + added, other.add_logit[turns] + added)
    came = turns[:, 1:]  # Where a turn follows, the one before it inserted an agent.
    if one.position_logits is not None and other.position_logits is not None:
        logits = one.position_logits[:, :-1], other.position_logits[:, :-1]
        found = found + _of_choice(logits[0][came], logits[1][came])
    if one.position_m is not None and other.position_m is not None:
        gap_m = (one.position_m - other.position_m)[:, :-1][came]
        found = found + _of_mean(gap_m / one.radius_m)
    return found


def _of_details(outputs: Outputs, pretrained: Outputs) -> Tensor:
    """Divergence of the types, headings, sizes and offsets of inserted agents."""
    one, other = outputs.details, pretrained.details
    if one is None or other is None:
        return outputs.motion.motion_logits.new_zeros(())
    found = _of_choice(one.agent_type_logits, other.agent_type_logits)
    found = found + _of_mean(one.size_log_m - other.size_log_m)
    for logits, others in (
        (one.heading_logits, other.heading_logits),
        (one.offset_logits, other.offset_logits),
    ):
        if logits is not None and others is not None:
            found = found + _of_choice(logits, others)
    for own, theirs in (
        (one.turned_rad, other.turned_rad),
        (one.offset_m, other.offset_m),
    ):
        if own is not None and theirs is not None:
            found = found + _of_mean(own - theirs)
    return found


def _of_choice(logits: Tensor, others: Tensor) -> Tensor:
    own, theirs = logits.log_softmax(dim=-1), others.log_softmax(dim=-1)
    return (own.exp() * (own - theirs)).sum()


def _of_event(logit: Tensor, other: Tensor) -> Tensor:
    happens = logit.sigmoid()
    found = happens * (logsigmoid(logit) - logsigmoid(other))
    return (found + (1 - happens) * (logsigmoid(-logit) - logsigmoid(-other))).sum()


def _of_mean(gap: Tensor) -> Tensor:
    return gap.square().sum() / 2
