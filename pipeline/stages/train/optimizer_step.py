"""One optimiser step: the gradient of a whole batch, however it is cut up, and the update.

A batch may be cut into parts, done one after the other and by several processes. Every
loss term is its sum over all parts divided by the sum of its weights over all parts; the
latter are known beforehand (``Supervision``), so gradients simply add up.

A step that simulates rollouts may have several updates (``updates``), each of them such a
sum over its part of the rollouts. It is done whole or not at all.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from signal import SIGTERM

import torch
from torch import Tensor

from infgen.config import TrainSettings
from infgen.model.batching.batch import Batch
from infgen.model.batching.supervision import TERMS
from infgen.model.device.packed import PackedBatch
from infgen.model.training.losses import Term, Terms
from infgen.model.training.policy_gradient.lessons import SUMS
from pipeline.engine import signals
from pipeline.engine.signals import Stopped
from pipeline.stages.train.lessons import Lessons, each_terms, prepare_lessons
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import TrainingError
from pipeline.stages.train.updates import cut_into_updates
from pipeline.storage.checkpoint import TrainingState, undone_on_error

LEAST_WEIGHT = 1e-6
SEED_BITS = 16
FIGURES = ("loss", "weight", "count", "right", "event")
"""Sums of a term, as ``Term`` has them."""


class NotFiniteError(TrainingError):
    """A step whose loss or gradient is not finite; no weight has been touched.

    Attributes:
        terms: Names of the loss terms that are not finite.
        parts: Numbers of the parts of the batch whose loss is not finite.
    """

    def __init__(self, terms: Sequence[str], parts: Sequence[int]) -> None:
        super().__init__(f"not finite: {', '.join(terms) or 'gradient'}")
        self.terms, self.parts = tuple(terms), tuple(parts)


@dataclass(frozen=True, slots=True)
class StepResult:
    """What is known of one step.

    Attributes:
        terms: The loss before it, of the whole batch.
        norm: Of the gradient, before it was clipped.
        surprise: Sum of the negative log-likelihoods of moves, and their number.
        rollouts: ``policy_gradient.lessons.SUMS`` of simulated rollouts; None without any.
    """

    terms: Terms
    norm: float
    surprise: Tensor
    rollouts: Tensor | None = None

    @classmethod
    def of(cls, updates: Sequence["StepResult"]) -> "StepResult":
        """Put the updates of a step together: sums of terms, the mean of norms."""
        first, *others = updates
        if not others:
            return first
        terms = dict(first.terms)
        for each in others:
            for name, term in each.terms.items():
                terms[name] = terms[name] + term if name in terms else term
        norm = sum(each.norm for each in updates) / len(updates)
        surprise = torch.stack([each.surprise for each in updates]).sum(dim=0)
        return cls(terms, norm, surprise, first.rollouts)

    @property
    def perplexity(self) -> float:
        """Of the next moves."""
        total, count = self.surprise.tolist()
        return math.exp(min(total / max(count, 1.0), 700.0))


class OptimizerStep:
    """Does optimiser steps.

    All gradients lie in one tensor, zeroed before each step, followed by all other sums:
    one addition over all processes does for everything. A parameter that a batch does not
    reach has a gradient of zero.

    The host waits for a GPU once a step, for its figures. What a CPU does parameter by
    parameter, a GPU does for all at once: it has a thousand of them, most of them small.
    """

    def __init__(
        self,
        training: TrainingState,
        settings: TrainSettings,
        group: ProcessGroup,
        parts: int,
    ) -> None:
        self._training, self._settings, self._process_group = training, settings, group
        self.forward = Pass(training.network, settings)
        trained = (p for p in training.network.parameters() if p.requires_grad)
        self._parameters = parameters = list(trained)
        sizes = [p.numel() for p in parameters]
        tail = [len(TERMS) * len(FIGURES), 2, len(SUMS), parts]
        self._sums = parameters[0].new_zeros(sum(sizes) + sum(tail))
        self._gradient, self._figures = torch.split(self._sums, [sum(sizes), sum(tail)])
        terms, self._surprise, self._rollouts, self._bad = torch.split(self._figures, tail)
        self._terms = terms.view(len(TERMS), len(FIGURES))
        cut = zip(torch.split(self._gradient, sizes), parameters, strict=True)
        self._own = [part.view_as(parameter) for part, parameter in cut]
        for parameter, own in zip(parameters, self._own, strict=True):
            parameter.grad = own
        factors = [settings.loss_weight(name) for name in TERMS]
        # Filled, most of them at once, as the host would wait for a copy.
        self._factors = parameters[0].new_ones(len(factors))
        for at, factor in enumerate(factors):
            if factor != 1:
                self._factors[at] = factor
        self._on_cpu = self._sums.device.type == "cpu"

    def step(
        self, parts: Sequence[Batch | PackedBatch], own: range, step: int
    ) -> StepResult:
        """Do one step.

        Args:
            parts: This process's parts of the batch.
            own: Their numbers.
            step: Steps done before.

        Raises:
            NotFiniteError: on all processes, if the gradient is not finite.
            PeerError: if another process is gone.
            Stopped: on all processes, if the run is to stop between two updates. In all
                cases the weights are as before.
        """
        training, settings = self._training, self._settings
        training.network.train()
        lessons = [
            prepare_lessons(
                part,
                training.network,
                self.forward,
                settings,
                self._sums.device,
                noise_of_part(step, settings.seed, number),
            )
            for number, part in zip(own, parts, strict=True)
        ]
        seed = noise_of_part(step, settings.seed, own.start)
        updates = cut_into_updates(lessons, settings, seed)
        with undone_on_error(training) if settings.updates > 1 else nullcontext():
            stepped = StepResult.of(self._updates(updates, own, step))
        _move_average(training, settings, step)
        return stepped

    def _updates(
        self, updates: Iterable[Sequence[Lessons]], own: range, step: int
    ) -> list[StepResult]:
        """Do all updates of a step, unless the run is to stop before the last one."""
        found: list[StepResult] = []
        for lessons in updates:
            if found and self._process_group.any(signals.pending_signal() > 0):
                raise Stopped(signals.pending_signal() or SIGTERM)
            found.append(self._update(lessons, own, step))
        return found

    def _update(self, lessons: Sequence[Lessons], own: range, step: int) -> StepResult:
        """Update the weights once, by what all processes learn."""
        training, settings = self._training, self._settings
        weight = torch.stack([each.weight(settings) for each in lessons]).sum(dim=0)
        self._process_group.add_up(weight)
        self._sums.zero_()
        names: dict[str, None] = {}
        for number, each in zip(own, lessons, strict=True):
            torch.manual_seed(noise_of_part(step, settings.seed, number))  # For dropout.
            names |= self._add(each, weight, number)
        self._process_group.add_up(self._sums)
        found = torch.cat([self._clip()[None], self._figures]).cpu()
        norm, told = float(found[0]), self._told(found[1:], names)
        terms, surprise, rollouts, bad = told
        _check(norm, terms, bad)
        for group in training.optimiser.param_groups:
            group["lr"] = learning_rate(settings, step)
        training.optimiser.step()
        simulated = rollouts if settings.policy_gradient_rollouts else None
        return StepResult(terms, norm, surprise, simulated)

    def _add(self, lessons: Lessons, weight: Tensor, number: int) -> dict[str, None]:
        """Add the gradient and the sums of one part; return the names of its terms."""
        settings = self._settings
        names: dict[str, None] = {}
        if lessons.rollouts is not None:
            self._rollouts += lessons.rollouts.sums
        for terms, surprise in each_terms(lessons, self._training, self.forward, settings):
            loss = _share(terms, weight, self._factors)
            self._add_gradient(loss)
            nothing = loss.new_zeros(())
            none = Term(nothing, nothing, nothing, nothing, nothing)
            found = [
                getattr(terms.get(each, none), name) for each in TERMS for name in FIGURES
            ]
            sums = torch.stack([each.detach().float() for each in found])
            self._terms += sums.view_as(self._terms)
            self._surprise += surprise
            bad = (~torch.isfinite(loss.detach())).float()
            self._bad[number] = torch.maximum(self._bad[number], bad)
            names |= dict.fromkeys(terms)
        return names

    def _add_gradient(self, loss: Tensor) -> None:
        if self._on_cpu:
            loss.backward()  # type: ignore[no-untyped-call]
            return
        found = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        sums: list[Tensor] = []
        more: list[Tensor] = []
        for own, gradient in zip(self._own, found, strict=True):
            if gradient is not None:
                sums.append(own)
                more.append(gradient)
        torch._foreach_add_(sums, more)

    def _clip(self) -> Tensor:
        """Clip the gradient; return its norm before that."""
        most = self._settings.max_gradient_norm
        if self._on_cpu:
            return torch.nn.utils.clip_grad_norm_(self._parameters, most)
        norm = torch.linalg.vector_norm(self._gradient)
        self._gradient.mul_((most / (norm + 1e-6)).clamp(max=1.0))
        return norm

    def _told(
        self, figures: Tensor, names: Iterable[str]
    ) -> tuple[Terms, Tensor, Tensor, list[int]]:
        """Terms, surprise, rollouts and the parts that are not finite, on the host."""
        sizes = [self._terms.numel(), len(self._surprise), len(self._rollouts)]
        rows, surprise, rollouts, bad = torch.split(figures, [*sizes, len(self._bad)])
        rows = rows.view_as(self._terms)
        terms = {name: Term(*rows[TERMS.index(name)].unbind()) for name in names}
        return terms, surprise, rollouts, bad.nonzero()[:, 0].tolist()


def _check(norm: float, terms: Mapping[str, Term], bad: Sequence[int]) -> None:
    if math.isfinite(norm) and not bad:
        return
    infinite = [name for name, term in terms.items() if not torch.isfinite(term.loss)]
    raise NotFiniteError(infinite, bad)


def _share(terms: Terms, weight: Tensor, factors: Tensor) -> Tensor:
    """One part's share of the loss of the whole batch, by the factor of every term."""
    loss, at = torch.stack([term.loss for term in terms.values()]), map(TERMS.index, terms)
    both = torch.stack([factors, weight.clamp(min=LEAST_WEIGHT)])
    factor, own = torch.stack([both[:, each] for each in at], dim=1)
    return (factor * loss / own).sum()


def noise_of_part(step: int, seed: int, part: int) -> int:
    """Number that decides the dropout of one part of one step's batch.

    Torch takes 64 bits of it. Seeds that leave room for part and step keep their bits, for
    there are weights that name them; of others it is a hash.
    """
    if seed < 1 << SEED_BITS:
        return (seed << 64 - SEED_BITS) + (part << 32) + step
    digest = hashlib.sha256(f"{seed}/{part}/{step}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def learning_rate(settings: TrainSettings, step: int) -> float:
    """Rate of one step: a linear warm-up, then half a cosine down to nothing."""
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / settings.warmup_steps
    rest = max(1, settings.steps - settings.warmup_steps)
    share = min(1.0, (step - settings.warmup_steps) / rest)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


def _move_average(training: TrainingState, settings: TrainSettings, step: int) -> None:
    """Move the average towards the weights, faster at first: they are still far off."""
    decay = min(settings.ema_decay, (1 + step) / (10 + step))
    parameters = dict(training.network.named_parameters())
    averages, current = [], []
    for name, average in training.average.items():
        averages.append(average)
        current.append(parameters[name].detach())
    if averages:
        torch._foreach_lerp_(averages, current, 1 - decay)
