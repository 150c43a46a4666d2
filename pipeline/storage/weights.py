"""Weights on disk: safetensors with the vocabularies in them, and a page of JSON."""

import hashlib
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from infgen.config import ModelSettings, TokenSettings
from infgen.model.network import Network
from infgen.pretrained import builtin_weights
from infgen.settings import build
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.engine.atomic import StoreError, write_file, write_json
from pipeline.engine.layout import read_json
from pipeline.storage.initial_weights import DESCRIPTION, WEIGHTS

SCHEMA = "infgen.model/2"
MAX_NAMED = 3
MAX_SETTINGS = 16
MAX_SAID = 300
_REQUIRED = ("model", "tokenize", "vocabulary", "weights")


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> str:
    """Write named tensors atomically; return the sha256 of the file."""
    ready = {k: tensors[k].detach().cpu().contiguous() for k in sorted(tensors)}
    data = save(ready)
    write_file(path, data)
    return hashlib.sha256(data).hexdigest()


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read named tensors.

    Raises:
        StoreError: if the file is missing or damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from error


def save_network(
    folder: Path, network: Network, state: Mapping[str, Tensor], step: int
) -> str:
    """Write weights so that nothing else is needed to load them.

    Args:
        folder: Where to.
        network: Whose sizes, vocabularies and grid they are for.
        state: The weights (of the network itself, or averaged).
        step: Optimiser step they are from.

    Returns:
        Their fingerprint.
    """
    fingerprint = write_tensors(folder / WEIGHTS, state)
    about = {
        "schema": SCHEMA,
        "model": asdict(network.settings),
        "tokenize": asdict(network.grid_settings),
        "vocabulary": vocabulary_fingerprint(
            network.motion_vocabulary(), network.map_vocabulary()
        ),
        "parameters": sum(p.numel() for p in network.parameters()),
        "step": step,
        "weights": fingerprint,
    }
    write_json(folder / DESCRIPTION, about)
    return fingerprint


def load_network(folder: Path) -> Network:
    """Load the network whose weights a folder holds, ready for simulation.

    Raises:
        StoreError: if a file is missing, damaged, or of another schema.
    """
    about = read_description(folder)
    tensors = read_tensors(folder / WEIGHTS)
    motion, roads = _vocabularies(tensors)
    where = str(folder / DESCRIPTION)
    network = Network(
        build(ModelSettings, about["model"], where),
        motion,
        roads,
        build(TokenSettings, about["tokenize"], where),
    )
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:  # The message names every tensor.
        said = textwrap.shorten(str(error), MAX_SAID, placeholder=" ...")
        raise StoreError(
            f"{folder / WEIGHTS} does not fit its settings in {DESCRIPTION}: {said}"
        ) from error
    return network.eval()


def load_vocabularies(folder: Path) -> tuple[MotionVocabulary, MapVocabulary]:
    """Read the vocabularies that the weights in a folder were trained with.

    Raises:
        StoreError: if a file is missing, damaged, or of another schema.
    """
    read_description(folder)
    return _vocabularies(read_tensors(folder / WEIGHTS))


def copy_weights(network: Network, folder: Path) -> None:
    """Give a network the weights in a folder, made with the same vocabularies.

    Other tensors in the folder are ignored. Parts that may be added to trained weights
    (``Network.added_parts``) may be missing there.

    Raises:
        StoreError: naming the parameters that are missing there or of another shape; or if
            the weights were made with other vocabularies, or are not what they were.
    """
    about = read_description(folder)
    own_vocabularies = vocabulary_fingerprint(
        network.motion_vocabulary(), network.map_vocabulary()
    )
    if about["vocabulary"] != own_vocabularies:
        raise StoreError(
            f"{folder} was trained with vocabulary {about['vocabulary'][:12]}, expected "
            f"{own_vocabularies[:12]}; build-vocab must have the same settings and records"
            f"{_remedy(folder)}"
        )
    found = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    if found != about["weights"]:
        raise StoreError(f"{folder / WEIGHTS} is not the file that {DESCRIPTION} describes")
    tensors = read_tensors(folder / WEIGHTS)
    new = {
        f"{part}.{name}"
        for part, module in network.added_parts().items()
        for name, _ in module.named_parameters()
    } - tensors.keys()
    parameters = {k: p for k, p in network.named_parameters() if k not in new}
    unfit = [
        name
        for name, parameter in parameters.items()
        if name not in tensors or tensors[name].shape != parameter.shape
    ]
    if unfit:
        raise StoreError(
            f"{folder} has no weights of the right shape for {_first_names(unfit)}"
            f"{_differing_settings(about, network)}{_remedy(folder)}"
        )
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(tensors[name])


def _first_names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {more} more tensors" if more > 0 else "")


def _differing_settings(about: Mapping[str, Any], network: Network) -> str:
    """Name settings of a network that its weights were not trained with."""
    model, grid = asdict(network.settings), asdict(network.grid_settings)
    for section, asked in (("model", model), ("tokenize", grid)):
        had = about[section]
        other = [
            f"{section}.{name}={json.dumps(had[name])} (not {json.dumps(value)})"
            for name, value in asked.items()
            if had.get(name, value) != value
        ]
        more = len(other) - MAX_SETTINGS
        if more > 0:
            other = [*other[:MAX_SETTINGS], f"and {more} more, all in its {DESCRIPTION}"]
        if other:
            return f"; they were trained with {', '.join(other)}"
    return ""


def _remedy(folder: Path) -> str:
    """Name the profile that fits the weights of the package."""
    own = folder.resolve() == builtin_weights().resolve()
    return "; --profile pretrained has all that goes with them" if own else ""


def read_description(folder: Path) -> dict[str, Any]:
    """Read the description of the weights in a folder.

    Raises:
        StoreError: if there are none, or they are of another schema.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        raise StoreError(f"{path} is missing; run stage 'train' first")
    read = read_json(path)
    about: dict[str, Any] = read if isinstance(read, dict) else {}
    if about.get("schema") != SCHEMA:
        raise StoreError(
            f"{path} holds {about.get('schema')!r}, expected {SCHEMA!r}; run stage 'train' "
            "again"
        )
    lacks = [name for name in _REQUIRED if name not in about]
    if lacks:
        raise StoreError(f"{path} lacks {', '.join(lacks)}; run stage 'train' again")
    return about


def vocabulary_fingerprint(motion: MotionVocabulary, roads: MapVocabulary) -> str:
    """Identity of two vocabularies: the same arrays, the same text."""
    digest = hashlib.sha256()
    for array in (motion.size_lw_m, motion.path, motion.real, roads.curve_m, roads.real):
        digest.update(f"{array.shape}{array.dtype}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def state_dict_of(network: torch.nn.Module) -> dict[str, Tensor]:
    """Weights and vocabularies of a network by name (not copied)."""
    return {name: tensor.detach() for name, tensor in network.state_dict().items()}


def _vocabularies(tensors: Mapping[str, Tensor]) -> tuple[MotionVocabulary, MapVocabulary]:
    return (
        MotionVocabulary(*_arrays(tensors, "motion_size_lw_m motion_path motion_real")),
        MapVocabulary(*_arrays(tensors, "road_curve_m road_real")),
    )


def _arrays(tensors: Mapping[str, Tensor], names: str) -> list[Any]:
    missing = [name for name in names.split() if name not in tensors]
    if missing:
        raise StoreError(f"the weights lack {', '.join(missing)}")
    return [tensors[name].numpy() for name in names.split()]
