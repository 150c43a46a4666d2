"""How much work the runs of a comparison are: scenes, steps, rollouts; nothing is run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from infgen.config import ReferenceSettings, RolloutSettings, TrainSettings, VocabSettings
from pipeline.comparison.runs import SCORE, TRAIN, ArmRun, Comparison
from pipeline.engine.plan import PlanError, PlannedStage

SCORED_LOGS = "score of logs"
"""The units of stage ``score`` that score logs; runs with the same settings share them."""
VALIDATION, CHECKPOINTS = "validation of training", "checkpoints"
"""Parts of stage ``train`` besides its steps."""
ITEMS = {
    "ingest": "scenes",
    "build-vocab": "scenes",
    "tokenize": "scenes",
    "train": "scenes shown",
    VALIDATION: "scenes",
    CHECKPOINTS: "checkpoints",
    "calibrate": "rollouts",
    "rollout": "rollouts",
    "reference": "scenes",
    SCORE: "rollouts",
    SCORED_LOGS: "logs",
}
"""What the work of a stage is counted in."""


@dataclass(frozen=True, slots=True)
class Split:
    """Records of one split.

    Attributes:
        files: Number of files.
        scenes: Number of scenes.
        counted: Files whose records were counted.
    """

    files: int
    scenes: int
    counted: int


Splits = Mapping[str, Split]


@dataclass(frozen=True, slots=True)
class Work:
    """One stage of one run.

    Attributes:
        stage: Its name.
        arm_run: The run that makes it.
        amount: How many of ``ITEMS``.
        units: Units that it is cut into.
        seconds: Length of the rollouts it simulates or scores; 0 for other stages.
    """

    stage: str
    arm_run: ArmRun
    amount: int
    units: int
    seconds: float = 0.0


def workload(
    comparison: Comparison, arm_runs: Sequence[ArmRun], splits: Splits
) -> list[Work]:
    """List the work of all runs, each stage once though several runs share it.

    Raises:
        ConfigError: for settings that cannot be.
        PlanError: for a split that no record is of.
    """
    found: list[Work] = []
    known: set[tuple[str, str]] = set()
    for arm_run in arm_runs:
        plan = comparison.sketch(arm_run)
        # Fine-tuned weights follow from others, which a sketch does not have.
        own = arm_run.arm.name if arm_run.arm.starts_from else ""
        after = plan.after([TRAIN]) if TRAIN in plan.stages else set()
        for name, planned in plan.stages.items():
            key = (name, planned.key + (own if name in after else ""))
            if name in ITEMS and key not in known:
                known.add(key)
                work = _work(arm_run, plan.stages, planned, splits)
                found += [work] if work.amount else []
                if name == TRAIN:
                    most = plan.stages["ingest"].settings.max_scenes_per_file
                    found += _besides_steps(arm_run, planned, splits, most)
        if SCORE in plan.stages:
            key = (SCORED_LOGS, f"{plan['reference'].key} {plan[SCORE].settings}")
            if key not in known:
                known.add(key)
                logs = _work(arm_run, plan.stages, plan["reference"], splits)
                found.append(replace(logs, stage=SCORED_LOGS))
    return found


def _work(
    arm_run: ArmRun,
    stages: Mapping[str, PlannedStage],
    planned: PlannedStage,
    splits: Splits,
) -> Work:
    """Say how much one stage is."""
    name, settings = planned.name, planned.settings
    if name in ("ingest", "tokenize"):
        most = stages["ingest"].settings.max_scenes_per_file
        every = [_limited(split, most) for split in splits.values()]
        files = sum(split.files for split in splits.values())
        return Work(name, arm_run, sum(every), files)
    most = stages["ingest"].settings.max_scenes_per_file
    if name == "build-vocab":
        how: VocabSettings = settings
        parts = [split for split in (how.split, how.validation_split) if split in splits]
        scenes = sum(_limited(splits[split], most) for split in set(parts))
        return Work(name, arm_run, scenes, sum(splits[each].files for each in set(parts)))
    if name == TRAIN:
        train: TrainSettings = settings["train"]
        return Work(name, arm_run, train.steps * train.batch_scenes, 1)
    if name == "reference":
        reference: ReferenceSettings = settings["reference"]
        held_out = _find(splits, reference.split)
        return Work(name, arm_run, _limited(held_out, most), held_out.files)
    if name == "calibrate":
        return _calibration(arm_run, settings)
    played: RolloutSettings = stages["rollout"].settings
    scenes = _limited(_find(splits, played.split), most)
    scenes = min(scenes, played.max_scenes or scenes)
    units = -(-scenes // played.scenes_per_unit)
    return Work(name, arm_run, scenes * played.count, units, played.duration_s)


def _besides_steps(
    arm_run: ArmRun, planned: PlannedStage, splits: Splits, most: int
) -> list[Work]:
    """Count the validations and checkpoints of training, those in the end among them."""
    how: TrainSettings = planned.settings["train"]
    if not how.steps:
        return []
    validations = 1 + (
        how.steps // how.validate_every_steps if how.validate_every_steps else 0
    )
    held_out = _limited(splits.get(how.validation_split, Split(0, 0, 0)), most)
    saved = 1 + (
        (how.steps - 1) // how.checkpoint_every_steps if how.checkpoint_every_steps else 0
    )
    amounts = {
        VALIDATION: validations * min(how.validation_scenes, held_out),
        CHECKPOINTS: saved,
    }
    return [
        Work(name, arm_run, amount, units=1) for name, amount in amounts.items() if amount
    ]


def _calibration(arm_run: ArmRun, settings: Mapping[str, Any]) -> Work:
    from pipeline.stages.flow_response import DESIGN  # noqa: PLC0415

    how = settings["calibrate"]
    scenes = how.max_scenes if how.method == "simulate" else 0
    units = len(DESIGN) * -(-scenes // how.scenes_per_unit)
    seconds = settings["rollout"].duration_s
    return Work("calibrate", arm_run, scenes * len(DESIGN), units, seconds)


def _limited(split: Split, most: int) -> int:
    """Scenes of a split of which each file gives so many; 0 for all."""
    return min(split.scenes, most * split.files) if most else split.scenes


def _find(splits: Splits, name: str) -> Split:
    if name not in splits:
        there = ", ".join(sorted(splits)) or "none"
        raise PlanError(f"no file of split {name!r} among the records; there is {there}")
    return splits[name]
