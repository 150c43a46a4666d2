"""A measured probe: a few scenes of the records through each stage, on this machine.

The stages do their real units of work, with the settings and the size of network of each
method; only fewer scenes, steps and rollouts. Seconds are those of a core, so that other
work on the machine does not count, or of the clock on a GPU. What is measured is kept in
the root, under the machine's name.
"""

import platform
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pipeline.comparison.costs import (
    Cost,
    cost_of_files,
    cost_of_rollouts,
    cost_of_scores,
    costs_of_training,
)
from pipeline.comparison.runs import ROLLOUT, SCORE, TRAIN, ArmRun, Comparison
from pipeline.comparison.sample import (
    RECORDS,
    SINGLES,
    read_sizes,
    write_sample,
)
from pipeline.comparison.workload import (
    CHECKPOINTS,
    SCORED_LOGS,
    VALIDATION,
    Split,
)
from pipeline.engine import machine
from pipeline.engine.atomic import StoreError, write_json
from pipeline.engine.events import Events
from pipeline.engine.layout import Root, read_json
from pipeline.engine.plan import PlanError, digest
from pipeline.engine.runner import RunOptions, run
from pipeline.storage.sources.source_files import RawRecords
from pipeline.workers.measured import MeasuredUnit, MeasuredWorkers

PLAYED_SCENES, PLAYED_TOGETHER = 4, 2
PLAYED_S, SHORT_S = 6.0, 2.0
"""Length of the rollouts, and of those whose scores tell what each further second takes."""
MOST_PLAYED = 16
"""Rollouts of a scene. As many as the settings say, up to this: they are simulated at once,
and one of several takes less than one alone."""
FEW_STEPS, LEAST_STEPS = 1, 4
"""Steps of two training runs: of one, and as many more as show every scene of the sample,
but so many at least."""
FEW_VALIDATED, MORE_VALIDATED = 1, RECORDS
"""Scenes of the validation that ends each."""
SETTINGS = {
    "train.warmup_steps": 1,
    "train.gradient_accumulation": 1,
    "train.checkpoint_every_steps": 0,
    "train.validate_every_steps": 0,
    "calibrate.method": "none",
    "rollout.max_scenes": PLAYED_SCENES,
    "rollout.scenes_per_unit": PLAYED_TOGETHER,
}
LONG, WOSAC = "long", "wosac"
CPU_BATCH, GPU_BATCH = 4, 16
"""Most scenes of a training step: some of what it takes is the same for one."""


@dataclass(frozen=True, slots=True)
class Probe:
    """What was measured.

    Attributes:
        costs: By ``kind``.
        splits: Records of each split.
        seconds: That measuring took; 0 where it was done before.
    """

    costs: Mapping[str, Cost]
    splits: Mapping[str, Split]
    seconds: float


def kind(arm_run: ArmRun, stage: str) -> str:
    """Name what costs alike: a stage of a method, whatever the seed.

    An ablation leaves out little of its method, and counts as that. Logs are scored alike
    whatever is compared with them.
    """
    if stage == SCORED_LOGS:
        return stage
    method = arm_run.arm.ablates or arm_run.arm.name
    played = stage in (ROLLOUT, SCORE)
    return "/".join([stage, method, *([arm_run.rollout_set] if played else [])])


def probe(
    comparison: Comparison,
    arm_runs: Sequence[ArmRun],
    records: RawRecords,
    tell: Callable[[str], None],
) -> Probe:
    """Measure what the stages of some runs cost, unless this machine did so before.

    Args:
        comparison: How the runs are planned.
        arm_runs: The runs.
        records: What they read.
        tell: Is told which run is measured.

    Raises:
        PlanError: if a stage fails, or there are no TFRecords.
    """
    begun = time.perf_counter()
    probed = _probed(arm_runs)
    path = probe_file(comparison.root)
    key = digest(
        {
            "machine": machine.describe(),
            "records": sorted(records.urls),
            "settings": {each.name: _keys(comparison, each) for each in probed},
            "probe": [
                RECORDS,
                SINGLES,
                MOST_PLAYED,
                [PLAYED_S, SHORT_S],
                [CPU_BATCH, GPU_BATCH],
                [FEW_STEPS, LEAST_STEPS],
                [FEW_VALIDATED, MORE_VALIDATED],
                SETTINGS,
                platform.python_version(),
            ],
        }
    )
    known = _read(path, key)
    if known is not None:
        return known
    sizes = read_sizes(records)
    splits = {name: each.split for name, each in sizes.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="probe-", dir=path.parent))
    try:
        write_sample(sizes, folder / "records", PLAYED_SCENES)
        costs = _measure(comparison, probed, splits, folder, tell)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    found = Probe(costs, splits, time.perf_counter() - begun)
    write_json(path, {"key": key, **asdict(found)})
    return found


def probe_file(root: Root) -> Path:
    """File of what this machine measured."""
    return root.path / "cache" / f"probe-{socket.gethostname()}.json"


def _probed(arm_runs: Sequence[ArmRun]) -> list[ArmRun]:
    """Choose the runs that are measured: one seed, and no ablation of a method."""
    methods = {arm_run.arm.name for arm_run in arm_runs}
    return [
        replace(arm_run, seed=0)
        for arm_run in arm_runs
        if arm_run.seed == arm_runs[0].seed and arm_run.arm.ablates not in methods
    ]


def _keys(comparison: Comparison, arm_run: ArmRun) -> Mapping[str, str]:
    plan = comparison.sketch(arm_run)
    return {name: planned.key for name, planned in plan.stages.items()}


def _read(path: Path, key: str) -> Probe | None:
    try:
        known = read_json(path)
    except StoreError:
        return None
    if not isinstance(known, dict) or known.get("key") != key:
        return None
    return Probe(
        costs={name: Cost(**cost) for name, cost in known["costs"].items()},
        splits={name: Split(**split) for name, split in known["splits"].items()},
        seconds=0.0,
    )


def _measure(
    comparison: Comparison,
    arm_runs: Sequence[ArmRun],
    splits: Mapping[str, Split],
    folder: Path,
    tell: Callable[[str], None],
) -> dict[str, Cost]:
    by_clock = bool(machine.describe()["gpus"])
    found: dict[str, Cost] = {}
    for arm_run in arm_runs:
        tell(arm_run.words)
        watched = MeasuredWorkers(by_clock)
        sample = _sample(comparison, arm_run, GPU_BATCH if by_clock else CPU_BATCH, folder)
        if kind(arm_run, TRAIN) not in found:
            found |= _train(sample, arm_run, watched, loads_code=not found)
        longer = _of_length(sample, _steps(sample, arm_run), MORE_VALIDATED)
        sample = replace(longer, targets=comparison.targets)
        _run(sample, arm_run, watched)
        played = _take(watched)
        if sample.plan(arm_run)[ROLLOUT].settings.mode != WOSAC:
            words = (*sample.overrides, f"rollout.seconds={SHORT_S}")
            _run(replace(sample, overrides=words), arm_run, watched)
        short = _take(watched)
        seconds = sample.plan(arm_run)[ROLLOUT].settings.duration_s
        for name, samples in played.items():
            if name == SCORE:
                cost = cost_of_scores(samples, short.get(SCORE, ()), seconds, SHORT_S)
            elif name == ROLLOUT:
                cost = cost_of_rollouts(samples, seconds)
            else:
                cost = cost_of_files(name, samples, splits)
            found.setdefault(kind(arm_run, name), cost)
    return found


def _train(
    sample: Comparison, arm_run: ArmRun, watched: MeasuredWorkers, *, loads_code: bool
) -> dict[str, Cost]:
    """Measure training; with ``loads_code``, after a run that only loads its code."""
    first = ((FEW_STEPS + 1, FEW_VALIDATED),) if loads_code else ()
    shorter = (FEW_STEPS, FEW_VALIDATED)
    longer = (_steps(sample, arm_run), MORE_VALIDATED)
    for length in (*first, shorter, longer):
        _run(_of_length(sample, *length), arm_run, watched)
    few, many = watched.samples.pop(TRAIN)[-2:]
    batch = _batch(sample, arm_run)
    found = costs_of_training(few, many, batch, (FEW_VALIDATED, MORE_VALIDATED))
    parts = {
        TRAIN: found.steps,
        VALIDATION: found.validation,
        CHECKPOINTS: found.checkpoint,
    }
    return {kind(arm_run, name): cost for name, cost in parts.items()}


def _batch(sample: Comparison, arm_run: ArmRun) -> int:
    batch: int = sample.sketch(arm_run)[TRAIN].settings["train"].batch_scenes
    return batch


def _steps(sample: Comparison, arm_run: ArmRun) -> int:
    """Count the steps of the longer run: one that is not counted, and an epoch."""
    return max(LEAST_STEPS, 1 + -(-RECORDS // _batch(sample, arm_run)))


def _take(watched: MeasuredWorkers) -> dict[str, list[MeasuredUnit]]:
    """Take what was measured, but training; units that score logs are apart."""
    found = dict(watched.samples)
    watched.samples.clear()
    found.pop(TRAIN, None)
    scored = found.pop(SCORE, [])
    found[SCORE] = [sample for sample in scored if "rollouts" in sample.report]
    found[SCORED_LOGS] = [sample for sample in scored if "logs" in sample.report]
    return {name: some for name, some in found.items() if some}


def _sample(
    comparison: Comparison, arm_run: ArmRun, most_scenes: int, folder: Path
) -> Comparison:
    """Let runs be short ones, of the sample, with so many scenes of a step at most."""
    plan = comparison.sketch(arm_run)
    played, trained = plan[ROLLOUT].settings, plan[TRAIN].settings["train"]
    own = {
        **SETTINGS,
        "train.batch_scenes": min(trained.batch_scenes, most_scenes),
        "rollout.count": min(played.count, MOST_PLAYED),
    }
    if played.mode != WOSAC:  # Waymo's protocol fixes the length of its rollouts.
        own["rollout.seconds"] = PLAYED_S
    if played.mode == LONG and not played.removal_radius_m:
        own["rollout.remove"] = "false"  # Untrained weights remove nearly all agents.
    words = (f"{name}={value}" for name, value in own.items())
    return replace(
        comparison,
        root=Root(folder / "root"),
        overrides=(*comparison.overrides, *words),
        records=(str(folder / "records"),),
    )


def _of_length(sample: Comparison, steps: int, validated: int) -> Comparison:
    """Let runs only train, so many steps, and validate so many scenes in the end."""
    words = (f"train.steps={steps}", f"train.validation_scenes={validated}")
    return replace(sample, overrides=(*sample.overrides, *words), targets=(TRAIN,))


def _run(sample: Comparison, arm_run: ArmRun, watched: MeasuredWorkers) -> None:
    """Make what a run makes, and measure its units.

    Raises:
        PlanError: if a stage fails.
    """
    options = RunOptions(workers=watched)
    for result in run(sample.plan(arm_run), options, Events(sample.root)):
        if result.state == "failed":
            why = next(iter(result.errors.values()))
            raise PlanError(f"the probe of {arm_run.words} failed: {result.stage}: {why}")
