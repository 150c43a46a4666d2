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
from typing import Any

from infgen.clock import CLOCK
from infgen.sources.tfrecord import Record, frame
from pipeline.comparison.runs import ROLLOUT, SCORE, TRAIN, ArmRun, Comparison
from pipeline.comparison.workload import (
    SCORED_LOGS,
    Split,
    count_splits,
    first_records,
)
from pipeline.engine import machine
from pipeline.engine.atomic import StoreError, write_json
from pipeline.engine.events import Events
from pipeline.engine.layout import Root, read_json
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import PlanError, digest
from pipeline.engine.runner import RunOptions, run
from pipeline.storage.sources.source_files import RawRecords
from pipeline.storage.splits import split_of
from pipeline.workers.measured import MeasuredUnit, MeasuredWorkers

FILES, RECORDS_EACH = 8, 2
"""Records that are read: of so many files of each split, and of each file."""
SAMPLE_FILES = 2
"""Files that they are written to: of every stage the first unit, which loads its code, is
not counted."""
PLAYED_SCENES, PLAYED_S = 3, 4.0
MOST_PLAYED = 16
"""Rollouts of a scene. As many as the settings say, up to this: they are simulated at once,
and one of several takes less than one alone."""
FEW_STEPS, MORE_STEPS = 1, 3
"""Training runs whose difference is that of their steps."""
SETTINGS = {
    "train.warmup_steps": 1,
    "train.batch_scenes": 1,
    "train.gradient_accumulation": 1,
    "train.checkpoint_every_steps": 0,
    "train.validation_scenes": 1,
    "calibrate.method": "none",
    "rollout.max_scenes": PLAYED_SCENES,
    "rollout.scenes_per_unit": 1,
}
WOSAC = "wosac"
OWN_FILES = 2
"""Of a unit, besides those of its stage: its manifest, and what is said of its run."""
GPU_BATCH = 16
"""Scenes of a training step on a GPU, where launches cost as much for one."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What one item of a stage's work takes.

    Attributes:
        seconds: Of a core, or of a GPU by the clock.
        per_token: Of these, those of one token step; 0 for stages that are no rollouts.
        bytes: On disk.
        bytes_per_s: On disk, for each second of a rollout.
        files: Of one unit.
    """

    seconds: float
    per_token: float = 0.0
    bytes: float = 0.0
    bytes_per_s: float = 0.0
    files: float = 0.0


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
                FILES,
                RECORDS_EACH,
                MOST_PLAYED,
                PLAYED_S,
                SETTINGS,
                platform.python_version(),
            ],
        }
    )
    known = _read(path, key)
    if known is not None:
        return known
    splits = count_splits(records)
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="probe-", dir=path.parent))
    try:
        costs = _measure(comparison, probed, records, folder, tell)
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
    records: RawRecords,
    folder: Path,
    tell: Callable[[str], None],
) -> dict[str, Cost]:
    _write_sample(records, folder / "records")
    by_clock = bool(machine.describe()["gpus"])
    batch = GPU_BATCH if by_clock else 1
    settings = SETTINGS | {"train.batch_scenes": batch}
    found: dict[str, Cost] = {}
    for arm_run in arm_runs:
        tell(arm_run.words)
        sample, watched = (
            _sample(comparison, arm_run, settings, folder),
            MeasuredWorkers(by_clock),
        )
        trained = kind(arm_run, TRAIN)
        if trained not in found:
            loads_code = () if found else (FEW_STEPS + 1,)
            for steps in (*loads_code, FEW_STEPS, MORE_STEPS):
                _run(_with_steps(sample, steps), arm_run, watched)
            few, more = watched.samples.pop(TRAIN)[-2:]
            per_step = (more.seconds - few.seconds) / (MORE_STEPS - FEW_STEPS)
            found[trained] = Cost(max(per_step, 0.0) / batch, files=float(_num_files(more)))
        whole = replace(_with_steps(sample, MORE_STEPS), targets=comparison.targets)
        _run(whole, arm_run, watched)
        seconds = whole.plan(arm_run)[ROLLOUT].settings.duration_s
        for name, samples in _by_work(watched.samples).items():
            found.setdefault(kind(arm_run, name), _cost(name, samples, seconds))
    return found


def _by_work(
    samples: Mapping[str, Sequence[MeasuredUnit]],
) -> dict[str, Sequence[MeasuredUnit]]:
    """Tell the units of stage ``score`` that score logs from those of rollouts."""
    scored = samples.get(SCORE, ())
    found = {
        **samples,
        SCORE: [sample for sample in scored if "rollouts" in sample.report],
        SCORED_LOGS: [sample for sample in scored if "logs" in sample.report],
    }
    return {name: some for name, some in found.items() if some}


def _sample(
    comparison: Comparison, arm_run: ArmRun, settings: Mapping[str, Any], folder: Path
) -> Comparison:
    """Let runs be short ones, of the sample."""
    played = comparison.sketch(arm_run)[ROLLOUT].settings
    own = {**settings, "rollout.count": min(played.count, MOST_PLAYED)}
    if played.mode != WOSAC:  # Waymo's protocol fixes the length of its rollouts.
        own["rollout.seconds"] = PLAYED_S
    words = (f"{name}={value}" for name, value in own.items())
    return replace(
        comparison,
        root=Root(folder / "root"),
        overrides=(*comparison.overrides, *words),
        records=(str(folder / "records"),),
    )


def _with_steps(sample: Comparison, steps: int) -> Comparison:
    """Let runs only train, so many steps."""
    words = (*sample.overrides, f"train.steps={steps}")
    return replace(sample, overrides=words, targets=(TRAIN,))


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


def _write_sample(records: RawRecords, folder: Path) -> None:
    """Write the first records of some files of each split."""
    folder.mkdir()
    splits: dict[str, list[str]] = {}
    for url in records.urls:
        splits.setdefault(split_of(url.rsplit("/", 1)[-1]), []).append(url)
    for split, urls in splits.items():
        found = first_records(urls, FILES, RECORDS_EACH)
        data = [frame(each.data) for each in found if isinstance(each, Record)]
        for at in range(SAMPLE_FILES):
            name = f"{split}.tfrecord-{at:05d}-of-{SAMPLE_FILES:05d}"
            (folder / name).write_bytes(b"".join(data[at::SAMPLE_FILES]))


def _cost(stage: str, samples: Sequence[MeasuredUnit], seconds: float) -> Cost:
    """Work out what one item takes, from all units but the first."""
    samples = samples[1:] or samples
    stored = sum(_num_bytes(sample) for sample in samples)
    each_unit = sum(_num_files(sample) for sample in samples) / len(samples)
    if stage == ROLLOUT:
        return _rollout_cost(samples, seconds, stored, each_unit)
    items = max(1, sum(_items(stage, sample.report) for sample in samples))
    spent = sum(sample.seconds for sample in samples)
    return Cost(spent / items, bytes=stored / items, files=each_unit)


def _num_bytes(sample: MeasuredUnit) -> int:
    return sum(size for size, _ in read_manifest(sample.folder)["files"].values())


def _num_files(sample: MeasuredUnit) -> int:
    return len(read_manifest(sample.folder)["files"]) + OWN_FILES


def _rollout_cost(
    samples: Sequence[MeasuredUnit], seconds: float, stored: int, files: float
) -> Cost:
    """Split what a rollout takes in what its scene does and what each token step does."""
    tokens = CLOCK.tokens_in(seconds)
    rollouts = max(1, sum(sample.report["rollouts"] for sample in samples))
    stepping = sum(sample.marks[-1] - sample.marks[0] for sample in samples)
    steps = sum(len(sample.marks) - 1 for sample in samples)
    spent = sum(sample.seconds for sample in samples)
    per_token = stepping / max(1, steps) * tokens
    share = min(per_token * len(samples), spent) / rollouts
    return Cost(
        seconds=max(0.0, spent / rollouts - share),
        per_token=share / tokens,
        bytes_per_s=stored / rollouts / seconds,
        files=files,
    )


def _items(stage: str, report: Mapping[str, Any]) -> int:
    """How many items a unit did."""
    if stage == "build-vocab":
        return int(report["learn"]) + int(report["held-out"])
    return int(report[{SCORE: "rollouts", SCORED_LOGS: "logs"}.get(stage, "scenes")])
