"""Stage ``build-vocab``: scenes to the two codebooks, and a report on what they can write.

A unit is one ingested file: a bounded sample of its moves and map pieces. Samples are
chosen by hashes of what they are, so neither workers nor the order of files matter.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from infgen.config import VocabSettings
from infgen.tokens.codebook import MotionCodebook, RoadCodebook
from pipeline.plan import PlanError
from pipeline.splits import in_split, split_of
from pipeline.stage import Done, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.scene import Scene
    from infgen.tokens.tracks import Paths

MOTION_SCHEMA, ROADS_SCHEMA = "infgen.motion/1", "infgen.roads/1"

LEARN, HELD_OUT, BOTH = "learn", "held-out", "both"
"""Roles of a file: source of moves, measure of them, or (by scene) either."""
HELD_OUT_EVERY = 8
"""Without a split to hold out, one scene in so many is."""

SCENES_PER_UNIT = {LEARN: 8, HELD_OUT: 250}
"""Scenes of a file whose tracks are matched when the codebook stands ..."""
SCENES_IN_ALL = {LEARN: 200, HELD_OUT: 1000}
"""... and of all files."""

_MERGE_EVERY = 16

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class KeyedPaths:
    """The tracks of one scene, and its hash."""

    key: int
    paths: "Paths"


def load_codebooks(folder: Path) -> tuple[MotionCodebook, RoadCodebook]:
    """Read both codebooks from the folder of this stage.

    Raises:
        StoreError: if one is missing or damaged.
    """
    from pipeline.store import read_records  # noqa: PLC0415

    motion = read_records(
        folder / "motion.zarr", MotionCodebook, MOTION_SCHEMA, mapped=False
    )
    roads = read_records(folder / "roads.zarr", RoadCodebook, ROADS_SCHEMA, mapped=False)
    return motion[0], roads[0]


def vocabulary_fingerprint(folder: Path) -> str:
    """Return the sha256 of both codebooks' arrays: what weights were trained for."""
    state = hashlib.sha256()
    for codebook in load_codebooks(folder):
        for field in fields(codebook):
            values: np.ndarray = getattr(codebook, field.name)
            state.update(f"{field.name} {values.dtype.str} {values.shape}".encode())
            state.update(np.ascontiguousarray(values).tobytes())
    return state.hexdigest()


def plan(inputs: Inputs, settings: VocabSettings) -> list[Unit]:
    """One unit per file of the two splits.

    Raises:
        PlanError: if there is no file to learn from.
    """
    files = inputs.units("ingest")
    learn = [done for done in files if in_split(done.name, settings.split)]
    held_out = [done for done in files if in_split(done.name, settings.held_out)]
    if not learn:
        found = ", ".join(sorted({split_of(done.name) for done in files})) or "none"
        raise PlanError(
            f"no file of split {settings.split!r} to build vocabularies from (there is: "
            f"{found}); set build-vocab.split"
        )
    others = [done for done in held_out if done not in learn]
    roles = {done.name: LEARN if others else BOTH for done in learn}
    roles |= {done.name: HELD_OUT for done in others}
    return [
        Unit(
            name=done.name,
            inputs={"scenes": done.key, "role": roles[done.name]},
            task={"scenes": str(done.path), "role": roles[done.name]},
        )
        for done in files
        if done.name in roles
    ]


def work(unit: Unit, target: Path, settings: VocabSettings, progress: Progress) -> Report:
    """Sample the moves, map pieces and tracks of one file."""
    from infgen.tokens.sample_keys import name_key  # noqa: PLC0415
    from pipeline.ingest import read_scenes  # noqa: PLC0415

    role = unit.task["role"]
    samples = {LEARN: _Sample(LEARN, settings), HELD_OUT: _Sample(HELD_OUT, settings)}
    for scene in read_scenes(Path(unit.task["scenes"])):
        held_out = name_key(scene.scenario_id) % HELD_OUT_EVERY == 0
        side = role if role != BOTH else HELD_OUT if held_out else LEARN
        samples[side].take(scene)
    for sample in samples.values():
        sample.write(target)
    return {
        "role": role,
        **{f"scenes_{side}": sample.scenes for side, sample in samples.items()},
    }


def finish(
    inputs: Inputs,
    units: Sequence[Done],
    target: Path,
    settings: VocabSettings,
    progress: Progress,
) -> Report:
    """Cluster all samples, and measure the codebooks on what was held out."""
    from infgen.tokens.clusters import cluster_moves, cluster_roads  # noqa: PLC0415
    from infgen.tokens.coverage import (  # noqa: PLC0415
        describe_moves,
        describe_roads,
        match_paths,
    )
    from infgen.views.codebooks import codebook_page  # noqa: PLC0415
    from pipeline.store import write_file, write_json, write_records  # noqa: PLC0415

    progress(0, 4, "segments")
    known, unknown = (_gather(units, side, settings) for side in (LEARN, HELD_OUT))
    progress(1, 4, "moves")
    motion, motion_origin = cluster_moves(known.segments, settings)
    progress(2, 4, "roads")
    roads, roads_origin, tolerance_m = cluster_roads(known.curves.curve_m, settings)
    write_records(
        target / "motion.zarr", [motion], MotionCodebook, MOTION_SCHEMA, compress=False
    )
    write_records(
        target / "roads.zarr", [roads], RoadCodebook, ROADS_SCHEMA, compress=False
    )
    progress(3, 4, "coverage")
    report = {
        "held_out": _held_out_words(units, settings),
        "scenes": sum(done.report[f"scenes_{LEARN}"] for done in units),
        "scenes_held_out": sum(done.report[f"scenes_{HELD_OUT}"] for done in units),
    }
    return report
