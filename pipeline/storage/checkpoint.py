"""Checkpoints: training resumes from them as if it had never stopped.

A checkpoint is a folder, complete once ``checkpoint.json`` names it. That file is replaced
atomically, so a kill at any time leaves the old or the new checkpoint. Random numbers, the
place in the data and the learning rate follow from the step alone.
"""

import copy
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from infgen.model.network import Network
from pipeline.engine.atomic import write_json
from pipeline.storage.weights import read_tensors, state_dict_of, write_tensors

POINTER = "checkpoint.json"
PREFIX = "checkpoint-"


@dataclass(frozen=True, slots=True)
class TrainingState:
    """A network as it is being trained.

    Attributes:
        network: The network.
        average: Moving average of its parameters, by name; empty if there is none.
        optimiser: AdamW over its parameters.
        pretrained: The network as it was before any step, which it is to stay near to; None
            if nothing is measured by it. No checkpoint holds it: it is that of the initial
            weights, whose fingerprint is part of the key.
    """

    network: Network
    average: dict[str, Tensor]
    optimiser: torch.optim.AdamW
    pretrained: Network | None = None


def save_checkpoint(folder: Path, training: TrainingState, step: int) -> None:
    """Write a checkpoint after ``step`` optimizer steps, then remove the one before."""
    target = folder / f"{PREFIX}{step:09d}"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    write_tensors(target / "network.safetensors", state_dict_of(training.network))
    write_tensors(target / "average.safetensors", training.average)
    write_tensors(target / "optimiser.safetensors", _optimiser_state(training))
    write_json(folder / POINTER, {"folder": target.name, "step": step})
    _drop(folder, keep=target.name)


def load_checkpoint(folder: Path, training: TrainingState) -> int:
    """Load the last checkpoint; return its optimizer step, 0 without one."""
    pointer = folder / POINTER
    if not pointer.is_file():
        return 0
    about = json.loads(pointer.read_text())
    source = folder / about["folder"]
    training.network.load_state_dict(read_tensors(source / "network.safetensors"))
    for name, value in read_tensors(source / "average.safetensors").items():
        training.average[name].copy_(value)
    _restore_optimiser(training, read_tensors(source / "optimiser.safetensors"))
    return int(about["step"])


@contextmanager
def undone_on_error(training: TrainingState) -> Iterator[None]:
    """Bring the network and its optimiser back to what they were if this fails."""
    network = copy.deepcopy(training.network.state_dict())
    optimiser = copy.deepcopy(training.optimiser.state_dict())
    try:
        yield
    except BaseException:
        training.network.load_state_dict(network)
        training.optimiser.load_state_dict(optimiser)
        raise


def remove_checkpoints(folder: Path) -> None:
    """Remove all checkpoints, the pointer first."""
    (folder / POINTER).unlink(missing_ok=True)
    _drop(folder, keep="")


def _drop(folder: Path, keep: str) -> None:
    for path in sorted(folder.glob(f"{PREFIX}*")):
        if path.name != keep:
            shutil.rmtree(path)


def _optimiser_state(training: TrainingState) -> dict[str, Tensor]:
    """State of every parameter as ``<parameter>/<what>``."""
    return {
        f"{name}/{what}": value
        for name, parameter in training.network.named_parameters()
        for what, value in training.optimiser.state.get(parameter, {}).items()
    }


def _restore_optimiser(training: TrainingState, tensors: dict[str, Tensor]) -> None:
    parameters = dict(training.network.named_parameters())
    for key, value in tensors.items():
        name, what = key.rsplit("/", 1)
        parameter = parameters[name]
        # Fused AdamW keeps the count of steps on the device, too.
        training.optimiser.state[parameter][what] = value.to(parameter.device)
