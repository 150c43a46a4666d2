"""The training loop: plain steps, one after the other, that can stop after any of them."""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.batch import Batch, Limits, to_device
from infgen.model.losses import Terms, figures, losses, total
from infgen.model.network import Network
from infgen.tokens.codebook import MotionCodebook, RoadCodebook
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.checkpoint import Training, load_checkpoint, save_checkpoint
from pipeline.loader import draw_of_step, held_out_batches, train_batches
from pipeline.stage import Progress
from pipeline.stopping import Stopped
from pipeline.train_log import TrainLog

LOG = "train.jsonl"
LOG_LINES = 1000
"""About so many steps are logged, evenly spread."""
TELL_EVERY_S = 0.5


class TrainingError(ValueError):
    """Training that cannot go on."""


@dataclass(frozen=True, slots=True)
class Course:
    """What is trained on what.

    Attributes:
        model: Sizes.
        train: How.
        grid: How the scenes were tokenized.
        scenes: To learn from.
        held_out: For the validation loss.
        folder: Where checkpoints and the log go.
    """

    model: ModelSettings
    train: TrainSettings
    grid: TokenSettings
    scenes: Sequence[SceneTokens]
    held_out: Sequence[SceneTokens]
    folder: Path

    @property
    def limits(self) -> Limits:
        """How much of a scene a batch holds."""
        return Limits.of(self.model, self.train, self.grid)


def begin(course: Course, motion: MotionCodebook, roads: RoadCodebook) -> Training:
    """Make a network with its first weights, and its optimiser."""
    torch.manual_seed(course.train.seed)
    network = Network(course.model, motion, roads, course.grid).to(device())
    parameters = list(network.parameters())
    decay = course.train.weight_decay
    optimiser = torch.optim.AdamW(
        [
            {"params": [p for p in parameters if p.dim() > 1], "weight_decay": decay},
            {"params": [p for p in parameters if p.dim() <= 1], "weight_decay": 0.0},
        ],
        lr=course.train.learning_rate,
        fused=True,
    )
    average = {name: p.detach().clone() for name, p in network.named_parameters()}
    return Training(network, average if course.train.ema_decay else {}, optimiser)


def train(course: Course, training: Training, progress: Progress) -> dict[str, float]:
    """Train from the last checkpoint on, to the last step.

    Returns:
        Validation figures of the final weights; empty without held-out scenes.

    Raises:
        TrainingError: if there is nothing to train on, or a loss is not finite.
    """
    settings = course.train
    if not len(course.scenes):
        raise TrainingError(f"no scenes of split {settings.split!r} to train on")
    with repeatable():
        first = load_checkpoint(course.folder, training)
        log = TrainLog(course.folder / LOG, first)
        pace = _Pace(settings, first, progress)
        for done, terms in _steps(course, training, first, log):
            if settings.validate_every and done % settings.validate_every == 0:
                log.add({"step": done, "validation": validate(course, training)})
            if done % settings.checkpoint_every == 0:
                _save(course, training, log, done)
            try:
                pace.tell(done, terms)
            except Stopped:
                _save(course, training, log, done)
                raise
        found = validate(course, training)
        log.add({"step": settings.steps, "validation": found})
        log.flush()
    return found


def _steps(
    course: Course, training: Training, first: int, log: TrainLog
) -> Iterator[tuple[int, Terms]]:
    """Do all steps from ``first`` on; yield how many are done and the last one's loss."""
    settings = course.train
    steps = range(first, settings.steps)
    every = max(1, settings.steps // LOG_LINES)
    batches = train_batches(
        course.scenes, course.limits, settings.batch_scenes, settings.seed, steps
    )
    for step, batch in zip(steps, batches, strict=True):
        try:
            terms, norm = train_step(training, batch, settings, step)
        except TrainingError:
            _save(course, training, log, step)  # The weights are still the last good ones.
            raise
        done = step + 1
        if done % every == 0:
            line = {"step": done, "learning_rate": learning_rate(settings, step)}
            log.add({**line, "gradient_norm": norm, **figures(terms)})
        yield done, terms


def _save(course: Course, training: Training, log: TrainLog, step: int) -> None:
    """Save a checkpoint, the log before it: lines beyond it are cut when going on."""
    log.flush()
    save_checkpoint(course.folder, training, step)


def train_step(
    training: Training, batch: Batch, settings: TrainSettings, step: int
) -> tuple[Terms, float]:
    """Do one optimiser step: the loss terms before it, and the norm of the gradient.

    Raises:
        TrainingError: if the gradient is not finite; the weights are as they were.
    """
    network, optimiser = training.network.train(), training.optimiser
    torch.manual_seed(draw_of_step(step, settings.seed))  # For dropout.
    for group in optimiser.param_groups:
        group["lr"] = learning_rate(settings, step)
    here = to_device(batch, device_of(network))
    outputs = network(here, hidden_roads=settings.map_weight > 0)
    terms = losses(outputs, here, settings)
    loss = total(terms, settings)
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    clipped = torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip_norm)
    norm = float(clipped)
    if not (math.isfinite(norm) and math.isfinite(float(loss.detach()))):
        scenes = ", ".join(batch.scenario_ids)
        raise TrainingError(f"step {step}: the loss is not finite; its scenes: {scenes}")
    optimiser.step()
    _move_average(training, settings, step)
    return {name: term.detach() for name, term in terms.items()}, norm


def learning_rate(settings: TrainSettings, step: int) -> float:
    """Rate of one step: a linear warm-up, then half a cosine down to nothing."""
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / settings.warmup_steps
    rest = max(1, settings.steps - settings.warmup_steps)
    share = min(1.0, (step - settings.warmup_steps) / rest)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


def _move_average(training: Training, settings: TrainSettings, step: int) -> None:
    """Move the average towards the weights, faster at first: they are still far off."""
    decay = min(settings.ema_decay, (1 + step) / (10 + step))
    with torch.no_grad():
        for name, parameter in training.network.named_parameters():
            if name in training.average:
                training.average[name].lerp_(parameter, 1 - decay)


def final_state(training: Training) -> dict[str, Tensor]:
    """Weights to keep: the averaged ones if there are any."""
    return {**training.network.state_dict(), **training.average}


@torch.no_grad()
def validate(course: Course, training: Training) -> dict[str, float]:
    """Figures of the averaged weights over the held-out scenes; empty without any."""
    settings = course.train
    network = training.network.eval()
    sums: Terms = {}
    for batch in held_out_batches(
        course.held_out,
        course.limits,
        settings.batch_scenes,
        settings.seed,
        settings.validation_scenes,
    ):
        here = to_device(batch, device_of(network))
        wanted = {"hidden_roads": settings.map_weight > 0}
        outputs = torch.func.functional_call(network, training.average, (here,), wanted)
        for name, term in losses(outputs, here, settings).items():
            sums[name] = sums[name] + term if name in sums else term
    if not sums:
        return {}
    return {"total": float(total(sums, settings)), **figures(sums)}


@contextmanager
def repeatable() -> Iterator[None]:
    """Make equal runs give equal bits, as long as they use as many threads.

    The number of threads is torch's own choice: all cores, or what OMP_NUM_THREADS says.
    """
    strict = torch.are_deterministic_algorithms_enabled()
    filled = torch.utils.deterministic.fill_uninitialized_memory  # type: ignore[attr-defined]
    torch.use_deterministic_algorithms(True, warn_only=device().type != "cpu")
    # Nothing here reads memory before it is written; filling it costs a tenth of a step.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.utils.deterministic.fill_uninitialized_memory = filled  # type: ignore[attr-defined]


def device() -> torch.device:
    """Where to compute: the first GPU if there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def device_of(network: Network) -> torch.device:
    """Where a network is."""
    return next(network.parameters()).device


class _Pace:
    """Tells progress, not more often than anyone can read."""

    def __init__(self, settings: TrainSettings, first: int, progress: Progress) -> None:
        self._settings, self._progress = settings, progress
        self._told, self._told_at = first, time.monotonic()

    def tell(self, done: int, terms: Terms) -> None:
        """Report a step done. Here a request to stop arrives, as ``Stopped``."""
        passed_s = time.monotonic() - self._told_at
        if passed_s < TELL_EVERY_S and done < self._settings.steps:
            return
        rate = (done - self._told) * self._settings.batch_scenes / max(passed_s, 1e-9)
        loss = float(total(terms, self._settings))
        self._told, self._told_at = done, time.monotonic()
        note = f"loss {loss:.3f}, {rate:.3g} scenes/s"
        self._progress(done, self._settings.steps, note)
