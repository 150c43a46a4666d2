"""One optimiser step: the gradient of a whole batch, however it is cut up, and the update.

A batch may be cut into parts, done one after the other and by several processes. Every
loss term is its sum over all parts divided by the sum of its weights over all parts; the
latter are known beforehand (``supervised``), so gradients simply add up.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from infgen.config import TrainSettings
from infgen.model.batching.batch import Batch, to_device
from infgen.model.training.closed_loop import close_loop
from infgen.model.training.diagnostics import motion_surprise
from infgen.model.training.loss_weights import TERMS, supervised
from infgen.model.training.losses import Term, Terms, losses
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import TrainingError
from pipeline.storage.checkpoint import TrainingState

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
    """

    terms: Terms
    norm: float
    surprise: Tensor

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
        parameters = list(training.network.parameters())
        sizes = [p.numel() for p in parameters]
        tail = (len(TERMS) * len(FIGURES), 2, parts)
        self._sums = parameters[0].new_zeros(sum(sizes) + sum(tail))
        gradient, terms, self._surprise, self._bad = torch.split(
            self._sums, [sum(sizes), *tail]
        )
        self._terms = terms.view(len(TERMS), len(FIGURES))
        for parameter, own in zip(parameters, torch.split(gradient, sizes), strict=True):
            parameter.grad = own.view_as(parameter)

    def step(self, parts: Sequence[Batch], own: range, step: int) -> StepResult:
        """Do one step.

        Args:
            parts: This process's parts of the batch.
            own: Their numbers.
            step: Steps done before.

        Raises:
            NotFiniteError: on all processes, if the gradient is not finite.
            PeerError: if another process is gone. In both cases the weights are as before.
        """
        training, settings = self._training, self._settings
        network = training.network.train()
        batches = [self._prepared(part) for part in parts]
        weight = torch.stack([supervised(batch, settings) for batch in batches]).sum(dim=0)
        self._process_group.add_up(weight)
        self._sums.zero_()
        names: list[str] = []
        for number, batch in zip(own, batches, strict=True):
            torch.manual_seed(noise_of_part(step, settings.seed, number))  # For dropout.
            names = self._add(batch, weight, number)
        self._process_group.add_up(self._sums)
        clipped = torch.nn.utils.clip_grad_norm_(
            network.parameters(), settings.max_gradient_norm
        )
        terms = self._all_terms(names)
        norm = float(clipped)
        self._check(norm, terms)
        for group in training.optimiser.param_groups:
            group["lr"] = learning_rate(settings, step)
        training.optimiser.step()
        _move_average(training, settings, step)
        return StepResult(terms, norm, self._surprise.clone())

    def _prepared(self, part: Batch) -> Batch:
        """Move a part to its device; simulate it for closed-loop fine-tuning."""
        here = to_device(part, self._sums.device)
        top = self._settings.closed_loop_top_k
        return close_loop(self._training.network, here, top) if top else here

    def _add(self, batch: Batch, weight: Tensor, number: int) -> list[str]:
        """Add the gradient and the sums of one part; return the names of its terms."""
        outputs = self.forward(batch)
        terms = losses(outputs, batch, self._settings)
        loss = _share(terms, weight, self._settings)
        loss.backward()  # type: ignore[no-untyped-call]
        for name, term in terms.items():
            found = [getattr(term, figure).detach().float() for figure in FIGURES]
            self._terms[TERMS.index(name)] += torch.stack(found)
        self._surprise += motion_surprise(outputs, batch)
        self._bad[number] = (~torch.isfinite(loss.detach())).float()
        return list(terms)

    def _all_terms(self, names: Sequence[str]) -> Terms:
        rows = self._terms.clone()
        return {name: Term(*rows[TERMS.index(name)].unbind()) for name in names}

    def _check(self, norm: float, terms: Mapping[str, Term]) -> None:
        bad = self._bad.nonzero()[:, 0].tolist()
        if math.isfinite(norm) and not bad:
            return
        infinite = [name for name, term in terms.items() if not torch.isfinite(term.loss)]
        raise NotFiniteError(infinite, bad)


def _share(terms: Terms, weight: Tensor, settings: TrainSettings) -> Tensor:
    """One part's share of the loss of the whole batch."""
    shares = [
        getattr(settings, f"{name}_weight")
        * term.loss
        / weight[TERMS.index(name)].clamp(min=LEAST_WEIGHT)
        for name, term in terms.items()
    ]
    return torch.stack(shares).sum()


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
    with torch.no_grad():
        for name, parameter in training.network.named_parameters():
            if name in training.average:
                training.average[name].lerp_(parameter, 1 - decay)
