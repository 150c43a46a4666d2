"""What is learned from one part of a batch: from logs, from rollouts, or from both."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from infgen.config import TrainSettings
from infgen.model.batching.batch import Batch
from infgen.model.batching.recovery import Recovery
from infgen.model.batching.supervision import Supervision, supervised_choices
from infgen.model.device.packed import IndexedBatch, PackedBatch, prepared
from infgen.model.network import Network
from infgen.model.training.closed_loop import close_loop
from infgen.model.training.closed_loop_population import close_population_loop
from infgen.model.training.diagnostics import motion_surprise
from infgen.model.training.losses import Terms, losses
from infgen.model.training.policy_gradient.choices import choices_made
from infgen.model.training.policy_gradient.lessons import PolicyLessons, simulate_lessons
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson
from infgen.model.training.policy_gradient.terms import policy_terms
from pipeline.stages.train.precision import Pass
from pipeline.storage.checkpoint import TrainingState


@dataclass(frozen=True, slots=True)
class LogLesson:
    """What is learned from scenes as logged, or near to the log.

    Attributes:
        given: The scenes.
        supervision: What is supervised of them.
    """

    given: IndexedBatch
    supervision: Supervision


@dataclass(frozen=True, slots=True)
class Lessons:
    """One part of a batch, to learn from.

    Attributes:
        log: Its scenes; None to leave the log out.
        rollouts: Rollouts of them; None for none.
    """

    log: LogLesson | None
    rollouts: PolicyLessons | None

    def only(self, rollouts: Sequence[int]) -> "Lessons":
        """Leave out all rollouts but these, by number."""
        assert self.rollouts is not None
        lessons = [self.rollouts.lessons[number] for number in rollouts]
        return replace(self, rollouts=replace(self.rollouts, lessons=lessons))

    def weight(self, settings: TrainSettings) -> Tensor:
        """Sum the weights of every term of the loss [term]."""
        found = []
        if self.log is not None:
            found.append(self.log.supervision.weight(settings))
        if self.rollouts is not None:
            counts = [lesson.moved.sum() for lesson in self.rollouts.lessons]
            none = self.rollouts.sums.new_zeros(())
            found.append(supervised_choices(sum(counts, start=none)))
        return torch.stack(found).sum(dim=0)


def prepare_lessons(
    part: Batch | PackedBatch,
    network: Network,
    forward: Pass,
    settings: TrainSettings,
    device: torch.device,
    seed: int,
) -> Lessons:
    """Move a part of a batch to its device; simulate it as the settings say."""
    here = prepared(part, device)
    rollouts = None
    if settings.policy_gradient_rollouts:
        rollouts = simulate_lessons(network, here.batch, settings, seed)
        if settings.updates > 1:
            rollouts = _with_log_probabilities(rollouts, network, forward, settings)
    if rollouts is not None and not settings.log_weight:
        return Lessons(None, rollouts)
    log = _near_log(here, network, settings, seed)
    return Lessons(LogLesson(log, log.supervision or Supervision.of(log.batch)), rollouts)


def _with_log_probabilities(
    rollouts: PolicyLessons, network: Network, forward: Pass, settings: TrainSettings
) -> PolicyLessons:
    """Note how likely the choices were before the weights change."""
    stationary, insertions = _stationary(network), _learns_of_insertions(network)

    def noted(lesson: PolicyLesson) -> PolicyLesson:
        outputs = forward.evaluated(network, lesson.batch, insertions)
        made = choices_made(outputs, lesson, stationary, settings.policy_top_p)
        return replace(lesson, log_probability=made.log_probability)

    network.eval()
    with torch.no_grad():
        found = replace(rollouts, lessons=[noted(each) for each in rollouts.lessons])
    network.train()
    return found


def _near_log(
    here: IndexedBatch, network: Network, settings: TrainSettings, seed: int
) -> IndexedBatch:
    """Simulate a batch near to its log for closed-loop fine-tuning."""
    top, recovery = settings.closed_loop_top_k, Recovery.of(settings)
    if settings.closed_loop_population:
        scale, own = settings.latent_rate_scale, settings.own_insertion_share
        simulated = close_population_loop(
            network, here.batch, top, seed, scale, recovery, own
        )
        return IndexedBatch(simulated, None, None)  # Others are there than in the log.
    if not top:
        return here
    simulated = close_loop(network, here.batch, top, recovery)
    return replace(here, batch=simulated, supervision=None)


def each_terms(
    lessons: Lessons, training: TrainingState, forward: Pass, settings: TrainSettings
) -> Iterator[tuple[Terms, Tensor]]:
    """Compute the terms of the loss, lesson by lesson, and the surprise of the log's moves.

    The caller adds up the gradient of one before it asks for the next: so much is in memory
    at once. Rollouts are learned from in evaluation mode: what is made likelier is what was
    sampled from.
    """
    if lessons.log is not None:
        batch, masks = lessons.log.given.batch, lessons.log.supervision.masks
        outputs = forward(batch, lessons.log.given.index)
        terms = losses(outputs, batch, settings, masks)
        yield terms, motion_surprise(outputs, batch, masks.motion)
    if lessons.rollouts is None:
        return
    network, pretrained = training.network, training.pretrained
    assert pretrained is not None
    stationary, insertions = _stationary(network), _learns_of_insertions(network)
    network.eval()
    for lesson in lessons.rollouts.lessons:
        outputs = forward.evaluated(network, lesson.batch, insertions)
        with torch.no_grad():
            before = forward.evaluated(pretrained, lesson.batch, insertions)
        terms = policy_terms(outputs, before, lesson, stationary, settings)
        yield terms, torch.zeros(2, device=lesson.moved.device)
    network.train()


def _stationary(network: Network) -> Tensor:
    """Motion tokens that stand still, by agent type, on the network's device."""
    found = torch.from_numpy(network.motion_vocabulary().stationary)
    return found.to(next(network.parameters()).device)


def _learns_of_insertions(network: Network) -> bool:
    """Whether insertions depend on what is trained: on all but the motion stack."""
    return any(
        parameter.requires_grad and not name.startswith("motion.")
        for name, parameter in network.named_parameters()
    )
