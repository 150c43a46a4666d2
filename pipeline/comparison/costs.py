"""What one item of a stage's work takes, worked out from measured units.

A unit costs something whatever is in it (files are opened, code and weights are loaded),
and something for each of its items. Units of two sizes tell them apart. The first unit of
a split is not counted: it loads code that no other loads again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from infgen.clock import CLOCK
from pipeline.comparison.workload import SCORED_LOGS, Split
from pipeline.engine.manifest import read_manifest
from pipeline.storage.splits import split_of
from pipeline.workers.measured import MeasuredUnit

OWN_FILES = 2
"""Of a unit, besides those of its stage: its manifest, and what is said of its run."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a stage's work takes.

    Attributes:
        seconds: Of a core, or of a GPU, for each item.
        per_unit: The same, for each unit, whatever is in it.
        per_token: The same, for each token step of an item; 0 for what has none.
        bytes: On disk, for each item.
        bytes_per_s: On disk, for each second of a rollout.
        files: Of one unit.
    """

    seconds: float
    per_unit: float = 0.0
    per_token: float = 0.0
    bytes: float = 0.0
    bytes_per_s: float = 0.0
    files: float = 0.0


def fit_line(points: Sequence[tuple[int, float]]) -> tuple[float, float]:
    """Tell a constant from what grows: ``seconds = constant + slope * items``.

    Neither is below zero: what would be is left out, and the other takes its place.

    Args:
        points: Items and seconds of each unit.

    Returns:
        The constant and the slope, by least squares.

    Examples:
        >>> fit_line([(1, 3.0), (3, 7.0)])
        (1.0, 2.0)
        >>> fit_line([(2, 4.0), (2, 6.0)])
        (0.0, 2.5)
        >>> fit_line([(1, 2.0), (3, 1.0)])
        (1.5, 0.0)
    """
    items, seconds = np.array(points, float).T
    if np.ptp(items):
        apart = items - items.mean()
        slope = float(apart @ seconds / (apart @ apart))
        constant = float(seconds.mean() - slope * items.mean())
        if slope < 0:
            return float(seconds.mean()), 0.0
        if constant >= 0:
            return constant, slope
    return 0.0, float(seconds.sum() / max(1.0, items.sum()))


def cost_of_files(
    stage: str, samples: Sequence[MeasuredUnit], splits: Mapping[str, Split]
) -> Cost:
    """Work out the cost of a stage whose units are files.

    Splits differ, as those of longer logs do; each counts as much as it has of all.

    Args:
        stage: The stage.
        samples: Its measured units.
        splits: How much there is of each split.
    """
    by_split: dict[str, list[MeasuredUnit]] = {}
    for sample in samples:
        by_split.setdefault(split_of(sample.name), []).append(sample)
    parts = {split: _of_one_split(stage, units) for split, units in by_split.items()}
    scenes = sum(splits[split].scenes for split in parts)
    files = sum(splits[split].files for split in parts)

    def mean(what: str, *, of_files: bool) -> float:
        return sum(
            getattr(part, what)
            * (splits[split].files / files if of_files else splits[split].scenes / scenes)
            for split, part in parts.items()
        )

    return Cost(
        seconds=mean("seconds", of_files=False),
        per_unit=mean("per_unit", of_files=True),
        bytes=mean("bytes", of_files=False),
        files=mean("files", of_files=True),
    )


def _of_one_split(stage: str, units: Sequence[MeasuredUnit]) -> Cost:
    units = units[1:] or units
    items = [_items(stage, unit.report) for unit in units]
    constant, slope = fit_line(
        [(count, unit.seconds) for count, unit in zip(items, units, strict=True)]
    )
    return Cost(
        seconds=slope,
        per_unit=constant,
        bytes=sum(_num_bytes(unit) for unit in units) / max(1, sum(items)),
        files=sum(map(num_files, units)) / len(units),
    )


def cost_of_rollouts(samples: Sequence[MeasuredUnit], seconds: float) -> Cost:
    """Split what rollouts take in what units, rollouts and token steps do.

    Args:
        samples: Units of some scenes.
        seconds: Length of a rollout.
    """
    samples = samples[1:] or samples
    tokens = CLOCK.tokens_in(seconds)
    rollouts = [int(sample.report["rollouts"]) for sample in samples]
    stepping = [_stepping_s(sample, tokens) for sample in samples]
    rest = [sample.seconds - spent for sample, spent in zip(samples, stepping, strict=True)]
    constant, slope = fit_line(list(zip(rollouts, rest, strict=True)))
    total = max(1, sum(rollouts))
    return Cost(
        seconds=slope,
        per_unit=constant,
        per_token=sum(stepping) / total / tokens,
        bytes_per_s=sum(map(_num_bytes, samples)) / total / seconds,
        files=sum(map(num_files, samples)) / len(samples),
    )


def _stepping_s(sample: MeasuredUnit, tokens: int) -> float:
    """Seconds of a unit's token steps: batches of rollouts report each, one after another.

    What precedes the first step of a batch, its map and history, is not among them.
    """
    batches = [sample.marks[at : at + tokens] for at in range(0, len(sample.marks), tokens)]
    return sum(
        (marks[-1] - marks[0]) / (len(marks) - 1) * len(marks)
        for marks in batches
        if len(marks) > 1
    )


def cost_of_scores(
    samples: Sequence[MeasuredUnit],
    short: Sequence[MeasuredUnit],
    seconds: float,
    short_s: float,
) -> Cost:
    """Work out what the scores of a rollout take.

    Args:
        samples: Units that score rollouts.
        short: The same with shorter rollouts; none where only one length is allowed.
        seconds: Length of a rollout.
        short_s: Length of a shorter one.
    """
    shorter = {sample.name: sample.seconds for sample in short[1:] or short}
    samples = samples[1:] or samples
    rollouts = [int(sample.report["rollouts"]) for sample in samples]
    total = max(1, sum(rollouts))
    tokens, per_token = CLOCK.tokens_in(seconds), 0.0
    if shorter:
        more_s = sum(
            unit.seconds - shorter.get(unit.name, unit.seconds) for unit in samples
        )
        more = tokens - CLOCK.tokens_in(short_s)
        per_token = max(0.0, more_s / total / more)
    rest = [
        (count, max(0.0, sample.seconds - count * tokens * per_token))
        for count, sample in zip(rollouts, samples, strict=True)
    ]
    constant, slope = fit_line(rest)
    return Cost(
        seconds=slope,
        per_unit=constant,
        per_token=per_token,
        bytes=sum(map(_num_bytes, samples)) / total,
        files=sum(map(num_files, samples)) / len(samples),
    )


@dataclass(frozen=True, slots=True)
class TrainingCosts:
    """What training takes.

    Attributes:
        steps: A scene shown, and what begins a run.
        validation: A scene of a validation.
        checkpoint: A checkpoint, or the weights in the end.
    """

    steps: Cost
    validation: Cost
    checkpoint: Cost


def costs_of_training(
    few: MeasuredUnit, many: MeasuredUnit, batch: int, validated: tuple[int, int]
) -> TrainingCosts:
    """Tell the steps of training from its beginning, its validation and its checkpoints.

    Args:
        few: A run of one step.
        many: One of several.
        batch: Scenes of a step.
        validated: Scenes of the validation that ends each of the two.
    """
    done = many.done[-1] - many.done[0]
    if done:  # Steps of one run: the beginning of another does not matter.
        step_s = (many.marks[-1] - many.marks[0]) / done
    else:
        steps = many.done[-1] - few.done[-1]
        step_s = max(0.0, many.seconds - few.seconds) / steps
    ends = (unit.seconds - unit.marks[-1] for unit in (few, many))
    saved_s, validation_s = fit_line(list(zip(validated, ends, strict=True)))
    begun_s = max(0.0, many.marks[0] - step_s * many.done[0])
    return TrainingCosts(
        steps=Cost(step_s / batch, per_unit=begun_s, files=float(num_files(many))),
        validation=Cost(validation_s),
        checkpoint=Cost(saved_s),
    )


def num_files(sample: MeasuredUnit) -> int:
    """Count the files of a unit."""
    return len(read_manifest(sample.folder)["files"]) + OWN_FILES


def _num_bytes(sample: MeasuredUnit) -> int:
    return sum(size for size, _ in read_manifest(sample.folder)["files"].values())


def _items(stage: str, report: Mapping[str, Any]) -> int:
    """How many items a unit did."""
    if stage == "build-vocab":
        return int(report["learn"]) + int(report["held-out"])
    return int(report["logs" if stage == SCORED_LOGS else "scenes"])
