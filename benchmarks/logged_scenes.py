"""Logs of a root's tokens, and the weights that are asked about them."""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from loader import shards

from infgen.model.batching.batch import Batch, Limits, collate
from infgen.model.network import Network
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.engine.manifest import read_manifest
from pipeline.stages.train.loader import TokenScenes
from pipeline.storage.splits import in_split
from pipeline.storage.weights import load_network


def asked(
    doc: str | None, arguments: Sequence[str] | None
) -> tuple[Network, Iterator[SceneTokens]]:
    """Read a benchmark's arguments; return the weights and the scenes they name."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stage tokenize")
    parser.add_argument("--weights", type=Path, help="default: those of the root")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--scenes", type=int, default=80)
    given = parser.parse_args(arguments)
    network = load_network(given.weights or given.root / "latest" / "train")
    units = shards(given.root)
    scenes = TokenScenes(
        [unit for unit in units if in_split(read_manifest(unit)["name"], given.split)]
    )
    count = min(given.scenes, len(scenes))
    if not count:
        parser.error(f"{given.root} has no tokens of split {given.split}; see --split")
    return network, (scenes[row] for row in range(count))


def whole(network: Network, scene: SceneTokens) -> Batch:
    """Make a batch of a scene, with all of its agents, roads and token steps."""
    roads = max(1, scene.num_map_tokens)
    limits = Limits(scene.num_agents, roads, 1, scene.num_tokens, network.grid_settings)
    return collate([scene], limits, draw=0)


def sum_over_logs(
    doc: str | None,
    arguments: Sequence[str] | None,
    look: Callable[[Network, SceneTokens], Any],
    report: Callable[[Any], list[dict[str, object]]],
) -> None:
    """Add up what is found in every scene, and print a table and a JSON object of it.

    Args:
        doc: The benchmark's description.
        arguments: Its arguments.
        look: Finds sums in a scene, an array.
        report: Prints the table of the sums of all scenes, and returns its rows.
    """
    network, scenes = asked(doc, arguments)
    found = [look(network, scene) for scene in scenes]
    print(json.dumps({"scenes": len(found), "rows": report(np.sum(found, axis=0))}))
