"""The training loop: plain steps, one after the other, that can stop after any of them."""

from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from signal import SIGTERM
from typing import Any

import torch
from torch import Tensor

from infgen.model.batching.perturbation import Perturbation, make_perturbation
from pipeline.engine import signals
from pipeline.engine.signals import Stopped
from pipeline.engine.stage import Progress
from pipeline.stages.train.loader import Recipe, train_batches
from pipeline.stages.train.optimizer_step import NotFiniteError, OptimizerStep, StepResult
from pipeline.stages.train.precision import Pass
from pipeline.stages.train.process_group import PeerError, ProcessGroup, own_device
from pipeline.stages.train.recorder import TrainingRecorder, is_validated
from pipeline.stages.train.setup import TrainingError, TrainingSetup, repeatable
from pipeline.stages.train.validation import validate
from pipeline.storage.checkpoint import TrainingState, load_checkpoint

WORKERS_OF_A_GPU = 2


@dataclass(frozen=True, slots=True)
class Trained:
    """What a whole run found.

    Attributes:
        validation: Figures of the final weights; empty without held-out scenes.
        run: Figures that differ from run to run.
    """

    validation: dict[str, Any]
    run: dict[str, Any]


def train(
    setup: TrainingSetup,
    training: TrainingState,
    progress: Progress,
    group: ProcessGroup | None = None,
) -> Trained:
    """Train from the last checkpoint on, to the last step.

    Args:
        setup: What on what; only the first process of a team writes to its folder.
        training: The network with its first weights.
        progress: Called by the first process.
        group: The processes that train together; None for this one alone.

    Raises:
        TrainingError: if there is nothing to train on, or a loss is not finite.
        PeerError: if another process is gone.
        Stopped: if the run is to stop; all is saved to go on.
    """
    group = group or ProcessGroup(device=own_device())
    recipe = replace(setup.recipe(group), noise=_noise(setup, training))
    with repeatable(), ExitStack() as stack:
        first = load_checkpoint(setup.folder, training)
        group.check_same(first, "steps done")
        optimizer_step = OptimizerStep(training, setup.train, group, recipe.parts)
        if not group.leads:
            _run_steps(setup, recipe, optimizer_step, group, first, None)
            return Trained({}, {})
        recorder = stack.enter_context(TrainingRecorder(setup, training, first, progress))
        run = _Run(setup, training, optimizer_step.forward, recorder)
        _run_steps(setup, recipe, optimizer_step, group, first, run)
        if first < setup.train.steps:
            recorder.save()  # Whatever ends what is left to do costs no step.
        found = run.validate()
        recorder.flush()
        return Trained(found, run.figures())


def _noise(setup: TrainingSetup, training: TrainingState) -> Perturbation | None:
    """How scenes are disturbed to learn from; held-out ones never are."""
    network = training.network
    return make_perturbation(
        setup.train, network.motion_vocabulary(), network.map_vocabulary()
    )


@dataclass(frozen=True, slots=True)
class _Run:
    """What the first process does besides the steps."""

    setup: TrainingSetup
    training: TrainingState
    forward: Pass
    recorder: TrainingRecorder

    def after(self, done: int, stepped: StepResult) -> None:
        """Write down one step, and all that is due after it."""
        self.recorder.add(done, stepped)
        if is_validated(self.setup.train, done):
            self.validate()
        self.recorder.keep_up(stepped)

    def validate(self) -> dict[str, Any]:
        """Find the figures of the held-out scenes and write them down."""
        found = validate(self.setup, self.training, self.forward)
        self.recorder.add_validation(found)
        return found

    def figures(self) -> dict[str, Any]:
        """What differs from run to run."""
        return {
            "scenes_per_s": round(
                self.recorder.throughput.overall(self.setup.train.steps), 3
            ),
            "bf16": self.forward.bf16,
            "compiled": self.forward.compiled,
        }


def _run_steps(
    setup: TrainingSetup,
    recipe: Recipe,
    optimizer_step: OptimizerStep,
    group: ProcessGroup,
    first: int,
    run: _Run | None,
) -> None:
    """Do all steps from ``first`` on. All processes of a team stop after the same one."""
    steps = range(first, setup.train.steps)
    stop: Stopped | None = None
    try:
        workers = _loader_workers(setup.train.loader_workers, group.device)
        with closing(train_batches(recipe, steps, workers)) as batches:
            for step, parts in zip(steps, batches, strict=True):
                if group.any(stop is not None or signals.pending_signal() > 0):
                    stop = stop or Stopped(signals.pending_signal() or SIGTERM)
                    break
                try:
                    stepped = _step(optimizer_step, recipe, parts, step)
                except Stopped as asked:
                    stop = asked
                    break
                try:
                    if run is not None:
                        run.after(step + 1, stepped)
                except Stopped as asked:
                    stop = asked
    except (TrainingError, PeerError):
        if run is not None:
            run.recorder.save()  # The weights are still the last good ones.
        raise
    if stop is not None:
        if run is not None:
            run.recorder.save()
        raise stop


def _loader_workers(asked: int | None, device: torch.device) -> int:
    """Processes that prepare batches."""
    if asked is not None:
        return asked
    return 0 if device.type == "cpu" else WORKERS_OF_A_GPU


def _step(
    optimizer_step: OptimizerStep, recipe: Recipe, parts: list[Any], step: int
) -> StepResult:
    """Do a step; say which scenes have a loss that is not finite, or too much memory."""
    try:
        return optimizer_step.step(parts, recipe.own, step)
    except torch.OutOfMemoryError as error:
        most = max(len(part.scenario_ids) for part in parts)
        why = str(error).splitlines()[0]
        raise TrainingError(
            f"step {step}: out of memory with {most} scenes at once; the steps before are "
            "saved. Free memory and run again, or begin anew with a larger "
            "train.gradient_accumulation (the batch in smaller parts, with the same "
            f"gradient) or a smaller train.batch_scenes: {why}"
        ) from error
    except NotFiniteError as error:
        bad = error.parts or range(recipe.parts)
        rows = [row for part in bad for row in recipe.rows(step, part)]
        scenes = ", ".join(recipe.scenes[row].scenario_id for row in rows)
        what = ", ".join(error.terms) or "the gradient"
        raise TrainingError(
            f"step {step}: the loss is not finite ({what}); its scenes: {scenes}"
        ) from error


def final_state(training: TrainingState) -> dict[str, Tensor]:
    """Weights to keep: the averaged ones if there are any."""
    return {**training.network.state_dict(), **training.average}
