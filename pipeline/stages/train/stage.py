"""Stage ``train``: token shards and vocabularies to weights.

One unit, in the driver's process. It saves a checkpoint every so many steps and goes on
from the last one; a run that was killed ends with the same bytes as one that was not.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.errors import ConfigError
from infgen.settings import build
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import RUN_FOLDER, read_json
from pipeline.engine.stage import (
    FinishedUnit,
    Inputs,
    Progress,
    Report,
    Source,
    Stage,
    Unit,
)
from pipeline.stages.devices import name_device
from pipeline.storage.initial_weights import (
    BUILTIN,
    DESCRIPTION,
    INITIAL_WEIGHTS,
    WEIGHTS,
    find_initial_weights,
)
from pipeline.storage.splits import in_split, source_of

if TYPE_CHECKING:
    from infgen.model.network import Network
    from pipeline.stages.train.process_group import ProcessGroup
    from pipeline.stages.train.setup import TrainingSetup
    from pipeline.storage.checkpoint import TrainingState

VOCABULARIES = ("motion.zarr", "roads.zarr")
OUTPUTS = (WEIGHTS, DESCRIPTION, "train.jsonl")
DONE = "trained.json"
"""Below ``run``: all else is written, and no checkpoint is needed any more."""


def load_network(folder: Path) -> "Network":
    """Load the network whose weights a stage folder holds, in evaluation mode.

    Raises:
        StoreError: if there is none, or it is damaged.
    """
    from pipeline.storage import weights  # noqa: PLC0415

    return weights.load_network(folder)


def reads(root: Path, settings: Mapping[str, Any]) -> list[Source]:
    """Find the weights to begin with, if any are named: a folder, or a key of this stage.

    Raises:
        ConfigError: if there are none, or the key is of several; or if none are named, and
            training is to stay near to them.
    """
    how: TrainSettings = settings["train"]
    for name in ("policy_gradient_rollouts", "initial_share"):
        if getattr(how, name) and not how.initial_weights:
            raise ConfigError(
                f"train.{name} is {getattr(how, name):g}, but "
                "train.initial_weights is empty; expected the weights to be fine-tuned: "
                f"{BUILTIN!r}, a folder, or the start of a key of stage train"
            )
    return find_initial_weights(root, "train.initial_weights", how.initial_weights)


def plan(inputs: Inputs, settings: Mapping[str, Any]) -> list[Unit]:
    """One unit, of all shards of the two splits.

    Raises:
        ConfigError: if shares are given to other sources than there are.
    """
    from pipeline.stages.train.source_shares import (  # noqa: PLC0415  # Numpy: 0.1 s.
        check_shares,
        read_shares,
    )

    how: TrainSettings = settings["train"]
    shards = {
        "scenes": _shards(inputs, how.split),
        "validation_split": _shards(inputs, how.validation_split),
    }
    sources = [source_of(done.name) for done in shards["scenes"]]
    if shares := read_shares(how.source_share):
        check_shares(shares, sources)
    keys = {f"{use}/{d.name}": d.key for use, dones in shards.items() for d in dones}
    keys |= {source.name: source.fingerprint for source in inputs.sources}
    folders = {use: [str(d.path) for d in dones] for use, dones in shards.items()}
    starts = {source.name: source.url for source in inputs.sources}
    return [
        Unit(
            name="weights",
            inputs={**keys, "vocabularies": inputs.content("build-vocab", *VOCABULARIES)},
            task={
                **folders,
                **starts,
                "sources": sources,
                "vocabularies": str(inputs.folder("build-vocab")),
            },
        )
    ]


def _shards(inputs: Inputs, split: str) -> list[FinishedUnit]:
    return [done for done in inputs.units("tokenize") if in_split(done.name, split)]


def work(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Train, or go on training, and write the averaged weights."""
    from pipeline.storage.checkpoint import remove_checkpoints  # noqa: PLC0415

    done = target / RUN_FOLDER / DONE
    if not done.is_file():
        write_json(done, _train(unit, target, settings, progress))
    remove_checkpoints(target)
    report: Report = read_json(done)
    return report


def _train(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    import torch  # noqa: PLC0415

    from pipeline.stages.train.initial_share import mixer  # noqa: PLC0415
    from pipeline.stages.train.loop import final_state, train  # noqa: PLC0415
    from pipeline.stages.train.process_group import form_group  # noqa: PLC0415
    from pipeline.stages.train.throughput import peak_memory_mib  # noqa: PLC0415
    from pipeline.storage.weights import save_network  # noqa: PLC0415

    begun = time.monotonic()
    target.mkdir(parents=True, exist_ok=True)
    how: TrainSettings = settings["train"]
    plain = {name: asdict(section) for name, section in settings.items()}
    call = {"task": dict(unit.task), "target": str(target), "settings": plain}
    with form_group(call, how.peer_timeout_s) as group:
        setup, training = _prepare(unit.task, target, settings)
        keep = mixer(setup, training)
        found = train(setup, training, progress, group)
    state = keep(final_state(training))
    weights = save_network(target, training.network, state, how.steps)
    return {
        "steps": how.steps,
        "scenes": setup.num_scenes,
        "validation_split": len(setup.validation_split),
        "parameters": sum(p.numel() for p in training.network.parameters()),
        "weights": weights,
        "device": group.device.type,
        "validation": found.validation,
        "run": {
            **found.run,
            "seconds": round(time.monotonic() - begun, 1),
            "threads": torch.get_num_threads(),
            "processes": group.size,
            "device": name_device(group.device, "bf16" if found.run["bf16"] else "float32"),
            "peak_memory_mib": round(peak_memory_mib(), 1),
        },
    }


def take_part(call: Mapping[str, Any], group: "ProcessGroup") -> None:
    """Do the steps of another process's ``work`` with it; write nothing."""
    from pipeline.stages.train.loop import train  # noqa: PLC0415

    settings: dict[str, Any] = {
        name: build(kind, call["settings"][name], name)
        for name, kind in STAGE.settings.items()
    }
    setup, training = _prepare(call["task"], Path(call["target"]), settings)
    train(setup, training, _say_nothing, group)


def _prepare(
    task: Mapping[str, Any], target: Path, settings: Mapping[str, Any]
) -> "tuple[TrainingSetup, TrainingState]":
    from pipeline.stages.train.loader import TokenScenes  # noqa: PLC0415
    from pipeline.stages.train.setup import TrainingSetup, begin  # noqa: PLC0415
    from pipeline.stages.vocabulary import load_vocabularies  # noqa: PLC0415

    setup = TrainingSetup(
        model=settings["model"],
        train=settings["train"],
        grid=settings["tokenize"],
        scenes=TokenScenes([Path(path) for path in task["scenes"]]),
        validation_split=TokenScenes([Path(path) for path in task["validation_split"]]),
        folder=target,
        start=Path(task[INITIAL_WEIGHTS]) if INITIAL_WEIGHTS in task else None,
        sources=tuple(task["sources"]),
    )
    return setup, begin(setup, *load_vocabularies(Path(task["vocabularies"])))


def _say_nothing(done: float, total: float, note: str = "") -> None:
    """Ignore progress: only the first process reports it."""


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Report:
    """Put the weights and their log in the stage's folder."""
    target.mkdir(parents=True, exist_ok=True)
    (unit,) = units
    for name in OUTPUTS:
        shutil.copyfile(unit.path / name, target / name)
    return {name: value for name, value in unit.report.items() if name != "run"}


STAGE = Stage(
    name="train",
    version=24,
    settings={"tokenize": TokenSettings, "model": ModelSettings, "train": TrainSettings},
    plan=plan,
    work=work,
    finish=finish,
    reads=reads,
    modules=(
        "pipeline.stages.devices",
        "pipeline.storage.checkpoint",
        "pipeline.stages.train.setup",
        "pipeline.stages.train.initial_share",
        "pipeline.stages.train.lessons",
        "pipeline.stages.train.optimizer_step",
        "pipeline.stages.train.recorder",
        "pipeline.stages.train.loader",
        "pipeline.stages.train.sampler",
        "pipeline.stages.train.source_shares",
        "pipeline.stages.train.precision",
        "pipeline.stages.train.stage",
        "pipeline.stages.train.train_log",
        "pipeline.stages.train.loop",
        "pipeline.stages.train.validation",
        "pipeline.storage.weights",
    ),
    resumes=True,
    in_driver=True,
)
