"""What the first process keeps of a training run: its log, its checkpoints, its pace."""

import time
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any

from infgen.config import TrainSettings
from infgen.model.training.losses import figures, total
from infgen.model.training.policy_gradient.lessons import figures as rollout_figures
from pipeline.engine.layout import RUN_FOLDER
from pipeline.engine.stage import Progress
from pipeline.stages.train.optimizer_step import StepResult, learning_rate
from pipeline.stages.train.setup import TrainingSetup
from pipeline.stages.train.tensorboard import EventFiles
from pipeline.stages.train.throughput import ThroughputMeter
from pipeline.stages.train.train_log import TrainLog
from pipeline.storage.checkpoint import TrainingState, save_checkpoint

LOG, PACE, EVENTS = "train.jsonl", "pace.jsonl", "tensorboard"
LOG_LINES = 1000
"""About so many steps are logged, evenly spread."""
S_PER_MINUTE = 60


class TrainingRecorder:
    """Writes down what each step gave, and saves what is needed to go on from it."""

    def __init__(
        self, setup: TrainingSetup, training: TrainingState, first: int, progress: Progress
    ) -> None:
        how, folder = setup.train, setup.folder
        self._course, self._training, self._progress = setup, training, progress
        self._every = max(1, how.steps // LOG_LINES)
        self._done = self._saved = first
        self._saved_at = time.monotonic()
        self._log = TrainLog(folder / LOG, first, validated=is_validated(how, first))
        run = folder / RUN_FOLDER
        self.throughput = ThroughputMeter(run / PACE, how.steps, first, how.batch_scenes)
        self._events: EventFiles | None = None
        self._files: AbstractContextManager[object] = nullcontext()
        if how.tensorboard:
            self._files = self._events = EventFiles(run / EVENTS, first)

    def __enter__(self) -> "TrainingRecorder":
        self._files.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.__exit__(kind, error, trace)

    def add(self, done: int, stepped: StepResult) -> None:
        """Take down one step, if its turn has come."""
        self._done = done
        if done % self._every:
            return
        line = {
            "learning_rate": learning_rate(self._course.train, done - 1),
            "gradient_norm": stepped.norm,
            "total": float(total(stepped.terms, self._course.train)),
            **figures(stepped.terms),
            **_perplexity(stepped),
            **_of_rollouts(stepped),
        }
        self._write("train", {"step": done, **line}, line)
        throughput = self.throughput.note(done)
        if self._events is not None:
            self._events.add("run", done, throughput)

    def add_validation(self, found: dict[str, Any]) -> None:
        """Take down the figures of the held-out scenes."""
        line = {"step": self._done, "validation": found}
        self._write("validation", line, found)

    def keep_up(self, stepped: StepResult) -> None:
        """Save a checkpoint and tell progress where they are due.

        Raises:
            Stopped: if the run is to stop.
        """
        if self._is_due():
            self.save()
        if self.throughput.due(self._done):
            loss = float(total(stepped.terms, self._course.train))
            self.throughput.tell(self._done, loss, self._progress)

    def save(self) -> None:
        """Save a checkpoint, the log before it: lines beyond it are cut when going on."""
        if self._saved == self._done and self._done:
            return
        self.flush()
        save_checkpoint(self._course.folder, self._training, self._done)
        self._saved, self._saved_at = self._done, time.monotonic()

    def flush(self) -> None:
        """Put the log on disk."""
        self._log.flush()

    def _is_due(self) -> bool:
        how = self._course.train
        by_step = (
            how.checkpoint_every_steps and self._done % how.checkpoint_every_steps == 0
        )
        after_s = how.checkpoint_minutes * S_PER_MINUTE
        return bool(by_step or 0 < after_s <= time.monotonic() - self._saved_at)

    def _write(self, group: str, line: dict[str, Any], figures: dict[str, Any]) -> None:
        self._log.add(line)
        if self._events is not None:
            self._events.add(group, self._done, figures)


def _perplexity(stepped: StepResult) -> dict[str, float]:
    """Perplexity of the log's motion tokens, if there were any to learn from."""
    counted = float(stepped.surprise[1]) > 0 or stepped.rollouts is None
    return {"motion_perplexity": stepped.perplexity} if counted else {}


def _of_rollouts(stepped: StepResult) -> dict[str, float]:
    """Figures of the rollouts that the network simulated, if it did."""
    return {} if stepped.rollouts is None else rollout_figures(stepped.rollouts)


def is_validated(how: TrainSettings, done: int) -> bool:
    """Whether the network is validated after so many steps; in the end it is once more."""
    return bool(how.validate_every_steps and done and done % how.validate_every_steps == 0)
