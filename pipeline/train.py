"""Stage ``train``: token shards and codebooks to weights.

One unit, in the driver's process. It saves a checkpoint every so many steps and goes on
from the last one; a run that was killed ends with the same bytes as one that was not.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from pipeline.splits import in_split
from pipeline.stage import Done, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.model.network import Network

CODEBOOKS = ("motion.zarr", "roads.zarr")
OUTPUTS = ("model.safetensors", "model.json", "train.jsonl")


def load_network(folder: Path) -> "Network":
    """Load the network whose weights a stage folder holds, ready to be played.

    Raises:
        StoreError: if there is none, or it is damaged.
    """
    from pipeline import weights  # noqa: PLC0415

    return weights.load_network(folder)


def plan(inputs: Inputs, settings: Mapping[str, Any]) -> list[Unit]:
    """One unit, of all shards of the two splits."""
    train: TrainSettings = settings["train"]
    shards = {
        "scenes": _shards(inputs, train.split),
        "held_out": _shards(inputs, train.held_out),
    }
    keys = {f"{use}/{d.name}": d.key for use, dones in shards.items() for d in dones}
    folders = {use: [str(d.path) for d in dones] for use, dones in shards.items()}
    return [
        Unit(
            name="weights",
            inputs={**keys, "codebooks": inputs.content("build-vocab", *CODEBOOKS)},
            task={**folders, "codebooks": str(inputs.folder("build-vocab"))},
        )
    ]


def _shards(inputs: Inputs, split: str) -> list[Done]:
    return [done for done in inputs.units("tokenize") if in_split(done.name, split)]


def work(
    unit: Unit, target: Path, settings: Mapping[str, Any], progress: Progress
) -> Report:
    """Train, or go on training, and write the averaged weights."""
    import torch  # noqa: PLC0415

    from pipeline.checkpoint import drop_checkpoints  # noqa: PLC0415
    from pipeline.loader import TokenScenes  # noqa: PLC0415
    from pipeline.training import Course, begin, final_state, train  # noqa: PLC0415
    from pipeline.vocabulary import load_codebooks  # noqa: PLC0415
    from pipeline.weights import save_network  # noqa: PLC0415

    begun = time.monotonic()
    target.mkdir(parents=True, exist_ok=True)
    model: ModelSettings = settings["model"]
    how: TrainSettings = settings["train"]
    grid: TokenSettings = settings["tokenize"]
    scenes = TokenScenes([Path(path) for path in unit.task["scenes"]])
    held_out = TokenScenes([Path(path) for path in unit.task["held_out"]])
    course = Course(model, how, grid, scenes, held_out, target)
    training = begin(course, *load_codebooks(Path(unit.task["codebooks"])))
    found = train(course, training, progress)
    weights = save_network(target, training.network, final_state(training), how.steps)
    drop_checkpoints(target)
    return {
        "steps": how.steps,
        "scenes": len(scenes),
        "held_out": len(held_out),
        "parameters": sum(p.numel() for p in training.network.parameters()),
        "weights": weights,
        "validation": found,
        "run": {
            "seconds": round(time.monotonic() - begun, 1),
            "threads": torch.get_num_threads(),
        },
    }


def finish(
    inputs: Inputs,
    units: Sequence[Done],
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
    version=1,
    settings={"tokenize": TokenSettings, "model": ModelSettings, "train": TrainSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "infgen.model.agents",
        "infgen.model.batch",
        "infgen.model.entries",
        "infgen.model.layers",
        "infgen.model.losses",
        "infgen.model.network",
        "infgen.model.outputs",
        "infgen.model.pairs",
        "infgen.model.relations",
        "infgen.model.roads",
        "infgen.model.sight",
        "infgen.model.window",
        "pipeline.checkpoint",
        "pipeline.loader",
        "pipeline.train",
        "pipeline.train_log",
        "pipeline.training",
        "pipeline.weights",
    ),
    resumes=True,
    in_driver=True,
)
