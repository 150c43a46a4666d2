"""How fast scenes become tokens, on one core, beside merely reading them.

The promise: at least 25 scenes a second and core for the whole stage. Scenes are read from
ingested files, tokenized with full-size vocabularies built from them, and written as the
stage writes them. Ingest and vocabularies are made first and not counted.

    python benchmarks/tokenize.py [RECORDS...] [--passes 3]

(``tokenize.py`` is the door; it explains why.)
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from infgen.tokens.tokenizer import tokenize_scene
from pipeline.engine.events import Events
from pipeline.engine.inputs import FinishedInputs
from pipeline.engine.layout import Root
from pipeline.engine.plan import PlannedStage
from pipeline.engine.runner import RunOptions, run
from pipeline.engine.stage import Inputs, Unit
from pipeline.settings.request import Request
from pipeline.settings.stages_file import DEFAULT_FILE
from pipeline.stages.vocabulary import load_vocabularies
from pipeline.storage.scenes import read_scenes
from pipeline.storage.sources.source_files import BUILTIN

SHARED = Path(__file__).parents[1] / "../shared/data/womd"
DEFAULT_RECORDS = ("training.*-0000[0-2]-of-*", "validation.*-00000-of-*")
GOAL = 25.0


class Timing(NamedTuple):
    """CPU-seconds (user and system) of the best pass over all scenes."""

    read_s: float
    tokenize_s: float
    stage_s: float


def main() -> None:
    """Measure, print a table, and last one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("records", nargs="*", help="TFRecords; shared or built-in ones")
    parser.add_argument("--passes", type=int, default=3, help="The best one counts.")
    asked = parser.parse_args()
    records = asked.records or default_records()
    with tempfile.TemporaryDirectory(prefix="infgen-bench-") as folder:
        planned, inputs = prepare(Root(Path(folder) / "root"), records)
        units = planned.stage.plan(inputs, planned.settings)
        scenes = sum(int(done.report["scenes"]) for done in inputs.units("ingest"))
        timing = measure(units, planned, Path(folder) / "tokens", asked.passes)
    report(timing, scenes)


def default_records() -> list[str]:
    """Four shared files; the built-in records where there are none."""
    if not SHARED.is_dir():
        return [BUILTIN]
    return [str(path) for words in DEFAULT_RECORDS for path in sorted(SHARED.glob(words))]


def prepare(root: Root, records: Sequence[str]) -> tuple[PlannedStage, Inputs]:
    """Ingest the records and build the vocabularies, uncounted."""
    request = Request(root, DEFAULT_FILE, None, tuple(records), ())
    root.path.mkdir(parents=True)
    for result in run(request.plan(["build-vocab"], {}), RunOptions(), Events(root, ())):
        if result.errors:
            sys.exit("\n".join(result.errors))
    planned = request.plan(["tokenize"], {})["tokenize"]
    return planned, FinishedInputs(root, planned)


def measure(
    units: Sequence[Unit], planned: PlannedStage, target: Path, passes: int
) -> Timing:
    """Time reading, tokenizing in memory, and the stage's own work, each on its own."""
    folders = [Path(unit.task["scenes"]) for unit in units]
    motion, roads = load_vocabularies(Path(units[0].task["vocabularies"]))
    scenes = [scene for folder in folders for scene in read_scenes(folder)]

    def read() -> None:
        for folder in folders:
            for _ in read_scenes(folder):
                pass

    def tokenize() -> None:
        for scene in scenes:
            tokenize_scene(scene, motion, roads, planned.settings)

    numbers = iter(range(1_000_000))

    def work() -> None:
        for unit in units:
            folder = target / f"{next(numbers):06d}"
            folder.mkdir(parents=True)
            planned.stage.work(unit, folder, planned.settings, _no_progress)

    work()  # imports and caches
    return Timing(*(best_s(task, passes) for task in (read, tokenize, work)))


def best_s(task: Callable[[], None], passes: int) -> float:
    """Return the CPU-seconds of the fastest of several passes."""
    taken = []
    for _ in range(passes):
        start = time.process_time()
        task()
        taken.append(time.process_time() - start)
    return min(taken)


def report(timing: Timing, scenes: int) -> None:
    """Print the table and the line of figures."""
    for name, seconds in zip(("read", "tokenize", "stage"), timing, strict=True):
        rate = scenes / seconds
        print(f"{name:10s}{1e3 * seconds / scenes:9.2f} ms/scene{rate:9.1f} scenes/s/core")
    figures = {
        "scenes": scenes,
        "scenes_per_s_per_core": round(scenes / timing.stage_s, 1),
        "tokenize_only_scenes_per_s_per_core": round(scenes / timing.tokenize_s, 1),
        "floor_read_scenes_per_s_per_core": round(scenes / timing.read_s, 1),
        "floor_ratio": round(timing.stage_s / timing.read_s, 2),
        "goal_scenes_per_s_per_core": GOAL,
        "peak_rss_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
    }
    print(json.dumps(figures))


def _no_progress(done: float, total: float, note: str = "") -> None:
    """Nobody watches a benchmark's units."""
