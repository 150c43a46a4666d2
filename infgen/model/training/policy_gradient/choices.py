"""What the network chose in a rollout: how likely it was, and how good it turned out.

Choices are motion tokens, the cells, types, headings and offset tokens of inserted agents,
removals, and insertions, those decided against included.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32
from torch import Tensor
from torch.nn.functional import logsigmoid

from infgen.model.batching.batch import Insertions
from infgen.model.batching.supervision import following
from infgen.model.latent_rates import Rate
from infgen.model.logits import DetailOutputs, InsertionOutputs, Outputs
from infgen.model.training.policy_gradient.nucleus import log_probability
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson
from infgen.tokens.scene_tokens import Presence

_Part = tuple[Tensor, Tensor]
"""Advantages and log-probabilities of choices of one kind."""


@dataclass(frozen=True, slots=True)
class ChoicesMade:
    """All choices of a rollout, kind by kind.

    Attributes:
        advantage: How much better than other rollouts it turned out.
        log_probability: By the network that is trained.
    """

    advantage: Float32[Tensor, " choice"]
    log_probability: Float32[Tensor, " choice"]


def choices_made(
    outputs: Outputs,
    lesson: PolicyLesson,
    stationary: Bool[Tensor, "3 motion_token"],
    top_p: float,
) -> ChoicesMade:
    """Find all choices of a rollout, always in the same order.

    Args:
        outputs: Of the network, in evaluation mode.
        lesson: The rollout.
        stationary: Motion tokens that stand still, by agent type.
        top_p: Share of the probability that motion tokens were sampled from.
    """
    parts = [
        _motion_tokens(outputs, lesson, stationary, top_p),
        *_inserted(outputs, lesson),
        *_counts(outputs, lesson),
    ]
    advantage, likely = (torch.cat(each) for each in zip(*parts, strict=True))
    return ChoicesMade(advantage, likely)


def decided(outputs: InsertionOutputs, entries: Insertions) -> Bool[Tensor, "row slot"]:
    """Turns in which an insertion was decided on: all that there were, and one more."""
    slot = torch.arange(entries.agent.shape[2], device=entries.agent.device)
    return slot <= outputs.rows.pack(entries.count)[:, None]


def removal_rate(outputs: Outputs, lesson: PolicyLesson) -> Float32[Tensor, " row"]:
    """What the latent rate added to the log-odds of every removal."""
    added = following(lesson.rate_log_odds[..., Rate.REMOVAL], 0)[..., None]
    return outputs.motion.rows.pack(added.expand(lesson.moved.shape))


def insertion_rate(
    outputs: InsertionOutputs, lesson: PolicyLesson
) -> Float32[Tensor, "row 1"]:
    """What the latent rate added to the log-odds of every insertion, at all turns."""
    return outputs.rows.pack(lesson.rate_log_odds[..., Rate.INSERTION])[:, None]


def _motion_tokens(
    outputs: Outputs, lesson: PolicyLesson, stationary: Tensor, top_p: float
) -> _Part:
    rows, agents = outputs.motion.rows, lesson.batch.agents
    moves = rows.pack(following(lesson.moved, False))
    chosen = rows.pack(following(agents.motion_token, 0))[moves]
    advantage = rows.pack(following(lesson.advantage, 0))[moves]
    agent_type = agents.agent_type[:, None].expand(agents.presence.shape)
    apart = stationary[rows.pack(agent_type)[moves]]
    logits = outputs.motion.motion_logits[moves]
    return advantage, log_probability(logits, apart, top_p, chosen)


def _inserted(outputs: Outputs, lesson: PolicyLesson) -> Iterator[_Part]:
    """Cells, types, headings and offset tokens of inserted agents."""
    entries = lesson.batch.entries
    if outputs.entries is not None and outputs.entries.position_logits is not None:
        rows, agent = outputs.entries.rows, entries.agent
        came = rows.pack(agent) >= 0
        advantage = lesson.advantage.gather(2, agent.clamp(min=0))
        likely = outputs.entries.position_logits[came].log_softmax(dim=-1)
        cell = rows.pack(entries.cell)[came][:, None]
        yield rows.pack(advantage)[came], likely.gather(1, cell)[:, 0]
    if outputs.details is not None:
        yield from _details(outputs.details, lesson)


def _details(outputs: DetailOutputs, lesson: PolicyLesson) -> Iterator[_Part]:
    details, rows = lesson.batch.details, outputs.rows
    scene = rows.at // details.present.shape[1]
    at = scene, rows.pack(details.token), rows.pack(details.agent)
    choices = [(outputs.agent_type_logits, details.agent_type, lesson.type_advantage)]
    if outputs.heading_logits is not None:
        choices.append((outputs.heading_logits, details.heading, lesson.advantage))
    if outputs.offset_logits is not None:
        choices.append((outputs.offset_logits, details.offset, lesson.advantage))
    for logits, chosen, advantage in choices:
        likely = logits.log_softmax(dim=-1).gather(1, rows.pack(chosen)[:, None])[:, 0]
        yield advantage[at], likely


def _counts(outputs: Outputs, lesson: PolicyLesson) -> Iterator[_Part]:
    """Insertions and removals, with the advantages of whole rollouts.

    Rewards of agents say nothing of them: they are costs, and who is not there has none.
    """
    motion, agents = outputs.motion, lesson.batch.agents
    if motion.remove_logit is not None:
        asked = motion.rows.pack(following(lesson.removable, False))
        leaves = motion.rows.pack(
            following(agents.presence == int(Presence.REMOVED), False)
        )
        after = following(following(lesson.count_advantage, 0), 0)[..., None]
        advantage = motion.rows.pack(after.expand(agents.presence.shape))
        logit = motion.remove_logit + removal_rate(outputs, lesson)
        yield advantage[asked], _log_event(logit, leaves)[asked]
    if outputs.entries is not None:
        rows, entries = outputs.entries.rows, lesson.batch.entries
        turns = decided(outputs.entries, entries)
        advantage = rows.pack(lesson.count_advantage)[:, None].expand(turns.shape)
        logit = outputs.entries.add_logit + insertion_rate(outputs.entries, lesson)
        likely = _log_event(logit, rows.pack(entries.add))
        yield advantage[turns], likely[turns]


def _log_event(logit: Tensor, happens: Tensor) -> Tensor:
    """Log-probability of what happened."""
    return logsigmoid(torch.where(happens, logit, -logit))
