"""How fast token shards become batches, and how much of a batch is padding.

The promise: batches ready ten times as fast as a training step uses them up. Scenes are
read from the token shards of an experiment; without ``--root`` one is made of some shared
records (or the built-in ones), which is not counted.

    python benchmarks/loader.py [--root ROOT] [--batch 16] [--workers 0 1 2]

The last line is one JSON object: ``sequences_per_s`` are scenes a second, in batches, made
by one thread; ``raw_sequences_per_s`` without making batches of them.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import fields, replace
from itertools import cycle, islice
from pathlib import Path

import numpy as np
from tokenize_speed import default_records
from torch import Tensor

from infgen.config import ModelSettings, TokenSettings, TrainSettings
from infgen.model.batching.batch import Batch, Limits
from infgen.model.batching.tensors import map_tensors
from infgen.model.device.packed import PackedBatch
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.commands.screen import show_table
from pipeline.engine.events import Events
from pipeline.engine.layout import Root
from pipeline.engine.runner import RunOptions, run
from pipeline.settings.request import Request
from pipeline.settings.stages_file import DEFAULT_FILE
from pipeline.stages.train.loader import Recipe, TokenScenes, train_batches
from pipeline.stages.train.process_group import ProcessGroup
from pipeline.stages.train.setup import TrainingSetup

SECONDS = 6.0
"""How long each figure is measured."""
FEW_MOVES = ("build-vocab.num_motion_tokens=256", "build-vocab.num_map_tokens=128")


def tokenized(records: Sequence[str], folder: Path) -> Path:
    """Make the token shards of some records, uncounted."""
    request = Request(Root(folder / "root"), DEFAULT_FILE, None, tuple(records), FEW_MOVES)
    request.root.path.mkdir(parents=True)
    for result in run(request.plan(["tokenize"], {}), RunOptions(), Events(request.root)):
        if result.errors:
            raise SystemExit("\n".join(result.errors))
    return request.root.path


def shards(root: Path) -> list[Path]:
    """Folders of the tokenized units of an experiment."""
    manifest = json.loads((root / "latest" / "tokenize" / "manifest.json").read_text())
    return [Root(root).unit("tokenize", unit["key"]) for unit in manifest["units"]]


def per_s(counts: Iterator[int]) -> float:
    """Add up for a while, and divide by the time it took."""
    begun, total = time.perf_counter(), 0
    for count in counts:
        total += count
        if time.perf_counter() - begun > SECONDS:
            break
    return total / (time.perf_counter() - begun)


def read(scene: SceneTokens) -> int:
    """Read every byte of a scene; return how many there are."""
    arrays = [getattr(scene, field.name) for field in fields(scene)]
    arrays = [array for array in arrays if isinstance(array, np.ndarray)]
    return sum(array.copy().nbytes for array in arrays)


def raw_rates(scenes: TokenScenes) -> tuple[float, float]:
    """Scenes and bytes a second, read in any order."""
    rows = np.random.default_rng(0).permutation(len(scenes)).tolist()
    mean = sum(read(scenes[row]) for row in rows) / len(rows)  # Also fills the page cache.
    found = per_s(1 for row in cycle(rows) if read(scenes[row]))
    return found, mean * found


def batch_rate(recipe: Recipe, workers: int) -> float:
    """Scenes a second in batches, the first batches not counted."""
    with closing(train_batches(recipe, range(1_000_000), workers)) as batches:
        for _ in islice(batches, 2 + 2 * workers):
            pass
        return per_s(len(parts[0].scenario_ids) for parts in batches)


def batch_bytes(batch: Batch | PackedBatch) -> int:
    """Bytes of all tensors of a batch."""
    sizes: list[int] = []

    def note(tensor: Tensor) -> Tensor:
        sizes.append(tensor.nbytes)
        return tensor

    map_tensors(batch, note)
    return sum(sizes)


def padding(recipe: Recipe, limits: Limits, pool: int) -> tuple[float, float]:
    """Shares of agents x tokens and of roads that are padding, over one epoch."""
    order = replace(recipe.order, pool=pool)
    real, padded = np.zeros(2), np.zeros(2)
    for step in range(len(recipe.scenes) // order.batch):
        scenes = [recipe.scenes[row] for row in order.scenes(step)]
        agents = np.array([min(s.num_agents, limits.agents) for s in scenes])
        tokens = np.array([min(s.num_tokens, limits.tokens) for s in scenes])
        roads = np.array([min(s.num_map_tokens, limits.roads) for s in scenes])
        real += [(agents * tokens).sum(), roads.sum()]
        padded += [len(scenes) * agents.max() * tokens.max(), len(scenes) * roads.max()]
    agents_share, roads_share = 1 - real / padded
    return float(agents_share), float(roads_share)


def report(root: Path, batch: int, workers: Sequence[int]) -> None:
    """Measure, print the tables, and last one line of JSON."""
    how = TrainSettings(batch_scenes=batch)
    scenes = TokenScenes(shards(root))
    course = TrainingSetup(ModelSettings(), how, TokenSettings(), scenes, [], root)
    recipe = course.recipe(ProcessGroup())
    raw, raw_bytes = raw_rates(scenes)
    rates = {count: batch_rate(recipe, count) for count in workers}
    size = float(np.mean([batch_bytes(recipe[step][0]) for step in range(8)]))
    pools = {"with buckets": how.bucket_batches, "as drawn": 1}
    shares = {name: padding(recipe, course.limits, n) for name, n in pools.items()}
    rows = [("shards, raw", raw, raw_bytes / 1e6)]
    for count, rate in rates.items():
        by = f"{count} processes" if count else "a thread"
        rows.append((f"batches of {batch} by {by}", rate, rate / batch * size / 1e6))
    show_table(f"{len(scenes)} scenes", ("what", "scenes/s", "MB/s"), rows)
    show_table(
        "padding, of agents x tokens and of roads",
        ("order", "agents", "roads"),
        [(name, f"{a:.1%}", f"{r:.1%}") for name, (a, r) in shares.items()],
    )
    figures = {
        "scenes": len(scenes),
        "sequences_per_s": round(rates[0], 1) if 0 in rates else None,
        "sequences_per_s_by_workers": {str(n): round(r, 1) for n, r in rates.items()},
        "raw_sequences_per_s": round(raw, 1),
        "raw_mb_per_s": round(raw_bytes / 1e6, 1),
        "padding": {n: [round(share, 4) for share in pair] for n, pair in shares.items()},
    }
    print(json.dumps(figures))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the shards of an experiment, or of one made for this."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--root", type=Path, help="of an experiment that is tokenized")
    parser.add_argument("--batch", type=int, default=16, help="scenes of a batch")
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 1, 2])
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="infgen-bench-") as folder:
        root = asked.root or tokenized(default_records(), Path(folder))
        report(root, asked.batch, asked.workers)


if __name__ == "__main__":
    main()
