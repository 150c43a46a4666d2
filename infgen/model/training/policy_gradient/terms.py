"""What is learned from rollouts: likelier good choices, near to the pretrained network.

The policy term is minus the sum of advantage times log-probability (Williams 1992); the
divergence is the Kullback-Leibler divergence from the network to the pretrained one, summed
over all choices of the rollout: motion tokens, removals, insertions, and the cells, types,
headings and offset tokens of inserted agents. Sizes and regressed offsets, which are not
sampled, count as means of normal distributions of variance one. The policy term has the
log-probability of no conflict beside it (``conflicts``). Both terms are divided by
the number of motion tokens, so ``divergence_weight`` is in rewards per nat.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32
from torch import Tensor
from torch.nn.functional import logsigmoid

from infgen.model.batching.batch import Batch, Insertions
from infgen.model.batching.supervision import following
from infgen.model.logits import DetailOutputs, InsertionOutputs, Outputs
from infgen.model.network import EGO
from infgen.model.training.losses import Term, Terms
from infgen.model.training.policy_gradient.conflicts import Conflicts
from infgen.model.training.policy_gradient.nucleus import log_probabilities
from infgen.tokens.scene_tokens import Presence

LEAST_ODDS = 1e-3
"""Where no conflict is less likely than this, little is learned any more."""


@dataclass(frozen=True, slots=True)
class PolicyLesson:
    """One rollout of every scene of a batch, to learn from.

    Attributes:
        batch: The rollouts.
        moved: Agents whose motion token was sampled.
        advantage: Of motion tokens, and of the cells, headings and offset tokens of
            inserted agents, at the token step that they led to.
        type_advantage: Of the type of every inserted agent.
        count_advantage: Of a rollout from a token step on: of its insertions there, and of
            the removals of the step before, whose agents are gone by then.
        conflicts: Motion tokens in conflict that were taken.
    """

    batch: Batch
    moved: Bool[Tensor, "scene token agent"]
    advantage: Float32[Tensor, "scene token agent"]
    type_advantage: Float32[Tensor, "scene token agent"]
    count_advantage: Float32[Tensor, "scene token"]
    conflicts: Conflicts


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
    gained = _motion_gain(outputs, lesson, stationary, top_p)
    gained = gained + conflict_penalty * _safe_gain(outputs, lesson.conflicts)
    gained = gained + _insertion_gain(outputs, lesson)
    gained = gained + _count_gain(outputs, lesson)
    nothing = gained.new_zeros(())

    def term(loss: Tensor) -> Term:
        return Term(loss, count, count, nothing, nothing)

    return {
        "policy": term(-gained),
        "divergence": term(divergence(outputs, pretrained, lesson)),
    }


def divergence(outputs: Outputs, pretrained: Outputs, lesson: PolicyLesson) -> Tensor:
    """Sum the divergence from the pretrained network over all choices."""
    rows, entries = outputs.motion.rows, lesson.batch.entries
    moves = rows.pack(following(lesson.moved, False))
    one, other = outputs.motion, pretrained.motion
    found = _of_choice(one.motion_logits[moves], other.motion_logits[moves])
    if one.remove_logit is not None and other.remove_logit is not None:
        asked = rows.pack(following(_removable(lesson), False))
        found = found + _of_event(one.remove_logit[asked], other.remove_logit[asked])
    if outputs.entries is not None and pretrained.entries is not None:
        decided = _decided(outputs.entries, entries)
        found = found + _of_insertions(outputs.entries, pretrained.entries, decided)
    return found + _of_details(outputs, pretrained)


def _motion_gain(
    outputs: Outputs, lesson: PolicyLesson, stationary: Tensor, top_p: float
) -> Tensor:
    """Advantages times log-probabilities of motion tokens, summed."""
    rows, agents = outputs.motion.rows, lesson.batch.agents
    moves = rows.pack(following(lesson.moved, False))
    chosen = rows.pack(following(agents.motion_token, 0))[moves]
    advantage = rows.pack(following(lesson.advantage, 0))[moves]
    agent_type = agents.agent_type[:, None].expand(agents.presence.shape)
    apart = stationary[rows.pack(agent_type)[moves]]
    logits = outputs.motion.motion_logits[moves]
    likely = log_probabilities(logits, apart, top_p, chosen)
    return (advantage * likely.gather(1, chosen[:, None])[:, 0]).sum()


def _safe_gain(outputs: Outputs, conflicts: Conflicts) -> Tensor:
    """Log-probabilities of no conflict, where there was one, summed."""
    scene, token, agent = conflicts.at.T
    row = outputs.motion.rows.number[scene, token - 1, agent]
    likely = outputs.motion.motion_logits[row].log_softmax(dim=-1)
    counts = conflicts.in_conflict * math.log(LEAST_ODDS)
    return (likely + counts).logsumexp(dim=-1).sum()


def _insertion_gain(outputs: Outputs, lesson: PolicyLesson) -> Tensor:
    """The same of the cells, headings, offset tokens and types of inserted agents."""
    gained = outputs.motion.motion_logits.new_zeros(())
    entries = lesson.batch.entries
    if outputs.entries is not None and outputs.entries.position_logits is not None:
        rows, agent = outputs.entries.rows, entries.agent
        came = rows.pack(agent) >= 0
        advantage = lesson.advantage.gather(2, agent.clamp(min=0))
        likely = outputs.entries.position_logits[came].log_softmax(dim=-1)
        cell = rows.pack(entries.cell)[came][:, None]
        gained = gained + (rows.pack(advantage)[came] * likely.gather(1, cell)[:, 0]).sum()
    return (
        gained
        if outputs.details is None
        else gained + _detail_gain(outputs.details, lesson)
    )


def _detail_gain(outputs: DetailOutputs, lesson: PolicyLesson) -> Tensor:
    """The same of the types, headings and offset tokens."""
    details, rows = lesson.batch.details, outputs.rows
    scene = rows.at // details.present.shape[1]
    at = scene, rows.pack(details.token), rows.pack(details.agent)
    choices = [(outputs.agent_type_logits, details.agent_type, lesson.type_advantage)]
    if outputs.heading_logits is not None:
        choices.append((outputs.heading_logits, details.heading, lesson.advantage))
    if outputs.offset_logits is not None:
        choices.append((outputs.offset_logits, details.offset, lesson.advantage))
    gained = outputs.agent_type_logits.new_zeros(())
    for logits, chosen, advantage in choices:
        likely = logits.log_softmax(dim=-1).gather(1, rows.pack(chosen)[:, None])[:, 0]
        gained = gained + (advantage[at] * likely).sum()
    return gained


def _count_gain(outputs: Outputs, lesson: PolicyLesson) -> Tensor:
    """The same of insertions and removals, with the advantages of whole rollouts.

    Rewards of agents say nothing of them: they are costs, and who is not there has none.
    """
    motion, agents = outputs.motion, lesson.batch.agents
    gained = motion.motion_logits.new_zeros(())
    if motion.remove_logit is not None:
        asked = motion.rows.pack(following(_removable(lesson), False))
        leaves = motion.rows.pack(
            following(agents.presence == int(Presence.REMOVED), False)
        )
        after = following(following(lesson.count_advantage, 0), 0)[..., None]
        advantage = motion.rows.pack(after.expand(agents.presence.shape))
        likely = _log_event(motion.remove_logit, leaves)
        gained = gained + (advantage * likely)[asked].sum()
    if outputs.entries is not None:
        rows, entries = outputs.entries.rows, lesson.batch.entries
        decided = _decided(outputs.entries, entries)
        advantage = rows.pack(lesson.count_advantage)[:, None]
        likely = _log_event(outputs.entries.add_logit, rows.pack(entries.add))
        gained = gained + (advantage * likely)[decided].sum()
    return gained


def _removable(lesson: PolicyLesson) -> Bool[Tensor, "scene token agent"]:
    """Agents that might have been removed: those that moved, but for egos."""
    removable = lesson.moved.clone()
    removable[:, :, EGO] = False
    return removable


def _decided(outputs: InsertionOutputs, entries: Insertions) -> Bool[Tensor, "row slot"]:
    """Turns in which an insertion was decided on: all that there were, and one more."""
    slot = torch.arange(entries.agent.shape[2], device=entries.agent.device)
    return slot <= outputs.rows.pack(entries.count)[:, None]


def _log_event(logit: Tensor, happens: Tensor) -> Tensor:
    """Log-probability of what happened."""
    return logsigmoid(torch.where(happens, logit, -logit))


def _of_insertions(
    one: InsertionOutputs, other: InsertionOutputs, decided: Tensor
) -> Tensor:
    """Divergence of insertions, and of the cells of those that there were."""
    found = _of_event(one.add_logit[decided], other.add_logit[decided])
    came = decided[:, 1:]  # Where a turn follows, the one before it inserted an agent.
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
