"""Stage ``build-vocab``: the two vocabularies of scenes, and a report on what they fit.

A unit is one ingested file: a bounded sample of its moves and map pieces. Samples are
chosen by hashes of what they are, so neither workers nor the order of files matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from infgen.config import TokenSettings, VocabSettings
from infgen.scene import Scene
from infgen.tokens.clustering.coverage import (
    describe_map,
    describe_motion,
    describe_source,
    match_paths,
)
from infgen.tokens.clustering.map_samples import (
    NO_MAP_SAMPLES,
    MapSamples,
    merge_map_samples,
    scene_map_samples,
)
from infgen.tokens.clustering.motion_samples import (
    NO_MOTION_SAMPLES,
    MotionSamples,
    merge_motion_samples,
    scene_motion_samples,
)
from infgen.tokens.clustering.physical_limits import motion_limits
from infgen.tokens.clustering.sample_keys import name_key
from infgen.tokens.clustering.vocabularies import Origin, cluster_map, cluster_motion
from infgen.tokens.tracks import Paths, TokensError, read_paths
from infgen.tokens.vocabulary import MapVocabulary, MotionVocabulary
from pipeline.engine.plan import PlanError
from pipeline.engine.stage import (
    FinishedUnit,
    Inputs,
    Progress,
    Report,
    Source,
    Stage,
    Unit,
)
from pipeline.storage.duplicates import read_task_scenes, scenes_task
from pipeline.storage.initial_weights import find_initial_weights
from pipeline.storage.splits import in_split, source_of, split_of

if TYPE_CHECKING:
    from pipeline.storage.columns import PackedRecords

T = TypeVar("T")

MOTION_SCHEMA, ROADS_SCHEMA = "infgen.motion/1", "infgen.roads/1"
SEGMENTS_SCHEMA, CURVES_SCHEMA = "infgen.segments/1", "infgen.curves/1"
PATHS_SCHEMA = "infgen.paths/1"

LEARN, HELD_OUT, BOTH = "learn", "held-out", "both"
"""Roles of a file: source of moves, measure of them, or (by scene) either."""
_SIDES = (LEARN, HELD_OUT)
HELD_OUT_EVERY = 8
"""Without a split to hold out, one scene in so many is."""

SCENES_PER_UNIT = {LEARN: 8, HELD_OUT: 250}
"""Scenes of a file whose tracks are matched once the vocabularies stand ..."""
SCENES_IN_ALL = {LEARN: 200, HELD_OUT: 1000}
"""... and of all files."""

_MERGE_EVERY = 16


@dataclass(frozen=True, slots=True)
class KeyedPaths:
    """The tracks of one scene.

    Attributes:
        key: Hash of the scene's id.
        paths: Its road users, ready for matching.
    """

    key: int
    paths: Paths


class _Gathered(NamedTuple):
    """One side's samples of all files."""

    segments: MotionSamples
    curves: MapSamples
    paths: Sequence[Paths]


class _Books(NamedTuple):
    """Both vocabularies, the ``Origin`` of their rows, and the radius of a map disk."""

    motion: MotionVocabulary
    move_origin: np.ndarray
    roads: MapVocabulary
    road_origin: np.ndarray
    road_tolerance_m: float


def load_vocabularies(folder: Path) -> tuple[MotionVocabulary, MapVocabulary]:
    """Read both vocabularies from the folder of this stage.

    Raises:
        StoreError: if one is missing or damaged.
    """
    motion = _read(folder / "motion.zarr", MotionVocabulary, MOTION_SCHEMA)
    roads = _read(folder / "roads.zarr", MapVocabulary, ROADS_SCHEMA)
    return motion[0], roads[0]


def reads(root: Path, settings: VocabSettings) -> list[Source]:
    """Find the weights whose vocabularies are taken, if any are named.

    Raises:
        ConfigError: if there are none, or a key is of several.
    """
    return find_initial_weights(
        root, "build-vocab.initial_weights", settings.initial_weights
    )


def plan(inputs: Inputs, settings: VocabSettings) -> list[Unit]:
    """One unit per file of the two splits.

    Vocabularies that are taken, not made, need no file to learn from.

    Raises:
        PlanError: if there is no file to learn from, or none at all.
    """
    files = inputs.units("ingest")
    learn = [done for done in files if in_split(done.name, settings.split)]
    validation_split = [
        done for done in files if in_split(done.name, settings.validation_split)
    ]
    if not learn and not (settings.initial_weights and validation_split):
        found = ", ".join(sorted({split_of(done.name) for done in files})) or "none"
        raise PlanError(
            f"no file of split {settings.split!r} to build vocabularies from (there is: "
            f"{found}); set build-vocab.split"
        )
    others = [done for done in validation_split if done not in learn]
    roles = {done.name: LEARN if others else BOTH for done in learn}
    roles |= {done.name: HELD_OUT for done in others}
    return [
        Unit(
            name=done.name,
            inputs={"scenes": done.key, "role": roles[done.name]},
            task={**scenes_task(done), "role": roles[done.name]},
        )
        for done in files
        if done.name in roles
    ]


def work(unit: Unit, target: Path, settings: VocabSettings, progress: Progress) -> Report:
    """Sample the moves, map pieces and tracks of one file."""
    role = unit.task["role"]
    samples = {side: _Sample(side, settings) for side in _SIDES}
    for scene in read_task_scenes(unit.task):
        validation_split = (
            role == BOTH and name_key(scene.scenario_id) % HELD_OUT_EVERY == 0
        )
        samples[HELD_OUT if validation_split or role == HELD_OUT else LEARN].take(scene)
    for sample in samples.values():
        sample.write(target)
    return {"role": role, **{side: sample.scenes for side, sample in samples.items()}}


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: VocabSettings,
    progress: Progress,
) -> Report:
    """Cluster all samples, and measure the vocabularies on what was held out."""
    progress(0, 4, "samples")
    learn, validation_split = (_gather(units, side, settings) for side in _SIDES)
    starts = [Path(source.url) for source in inputs.sources]
    books = _taken(starts[0]) if starts else _clustered(learn, settings, progress)
    motion, move_origin, roads, road_origin, road_tolerance_m = books
    _write(target / "motion.zarr", [motion], MotionVocabulary, MOTION_SCHEMA)
    _write(target / "roads.zarr", [roads], MapVocabulary, ROADS_SCHEMA)

    progress(3, 4, "coverage")
    matches, familiar = (
        match_paths(side.paths, motion) for side in (validation_split, learn)
    )
    report: dict[str, Any] = {
        "scenes": {side: sum(done.report[side] for done in units) for side in _SIDES},
        "validation_split": _held_out_words(units, settings),
        "tolerance_m": settings.tolerance_m,
        "road_tolerance_m": round(road_tolerance_m, 5),
        "motion": describe_motion(motion, move_origin, matches, familiar, settings),
        "roads": describe_map(
            roads, road_origin, validation_split.curves.curve_m, learn.curves.curve_m
        ),
    }
    report["sources"] = _by_source(units, books, settings)
    # Matplotlib takes longer to load than a cached run lasts.
    from infgen.views.charts.canvas import write_pdf  # noqa: PLC0415
    from infgen.views.charts.vocabularies import vocabulary_charts  # noqa: PLC0415
    from infgen.views.page import render  # noqa: PLC0415
    from pipeline.stages.vocabulary_tables import (  # noqa: PLC0415
        figures_table,
        sources_table,
    )
    from pipeline.storage.zarr_store import write_file, write_json  # noqa: PLC0415

    write_json(target / "report.json", report)
    motion_charts, map_chart = vocabulary_charts(motion, move_origin, roads, road_origin)
    page = render(
        "vocabularies.html",
        title="Vocabularies",
        report=report,
        motion_table=figures_table("Motion tokens", report["motion"]),
        map_table=figures_table("Map tokens", {"map tokens": report["roads"]}),
        sources_table=sources_table(report["sources"]),
        motion_charts=motion_charts,
        map_chart=map_chart,
    )
    write_file(target / "report.html", page.encode())
    write_file(target / "figures.pdf", write_pdf([*motion_charts, map_chart]))
    return _headline(report)


def _by_source(
    units: Sequence[FinishedUnit], books: "_Books", settings: VocabSettings
) -> dict[str, dict[str, Any]]:
    """Measure how the vocabularies fit each source: its held-out scenes if it has any."""
    found = {}
    for source in sorted({source_of(done.name) for done in units}):
        own = [done for done in units if source_of(done.name) == source]
        scenes = {side: sum(done.report[side] for done in own) for side in _SIDES}
        side = HELD_OUT if scenes[HELD_OUT] else LEARN
        gathered = _gather(own, side, settings)
        matches = match_paths(gathered.paths, books.motion)
        tokens = describe_source(matches, books.roads, gathered.curves.curve_m)
        held_out = side == HELD_OUT
        found[source] = {"scenes": scenes[side], "held_out": held_out, "tokens": tokens}
    return found


def _clustered(learn: _Gathered, settings: VocabSettings, progress: Progress) -> _Books:
    progress(1, 4, "moves")
    motion, move_origin = cluster_motion(learn.segments, settings)
    progress(2, 4, "roads")
    roads, road_origin, tolerance_m = cluster_map(learn.curves.curve_m, settings)
    return _Books(motion, move_origin, roads, road_origin, tolerance_m)


def _taken(folder: Path) -> _Books:
    """Take vocabularies from weights; what is not logged in them counts as made."""
    from pipeline.storage.weights import load_vocabularies as load  # noqa: PLC0415

    motion, roads = load(folder)
    move_origin, road_origin = (
        np.where(book.real, Origin.LOGGED, Origin.MADE).astype(np.int8)
        for book in (motion, roads)
    )
    return _Books(motion, move_origin, roads, road_origin, 0.0)


class _Sample:
    """One side's sample of one file, while it is read."""

    def __init__(self, side: str, settings: VocabSettings) -> None:
        self.scenes = 0
        self._side, self._settings = side, settings
        self._limits = motion_limits(settings)
        self._segments: list[MotionSamples] = []
        self._curves: list[MapSamples] = []
        self._paths: dict[int, Paths] = {}

    def take(self, scene: Scene) -> None:
        """Add one scene."""
        self.scenes += 1
        if self._side == LEARN:
            still_m = self._settings.tolerance_m
            self._segments.append(scene_motion_samples(scene, self._limits, still_m))
        self._curves.append(scene_map_samples(scene))
        self._take_paths(scene)
        if len(self._curves) == _MERGE_EVERY:
            self._merge()

    def write(self, target: Path) -> None:
        """Write the sample, if there is any, below the unit's folder."""
        if self.scenes == 0:
            return
        self._merge()
        folder = target / self._side
        folder.mkdir(parents=True)
        paths = [KeyedPaths(key, self._paths[key]) for key in sorted(self._paths)]
        _write(folder / "segments.zarr", self._segments, MotionSamples, SEGMENTS_SCHEMA)
        _write(folder / "curves.zarr", self._curves, MapSamples, CURVES_SCHEMA)
        _write(folder / "paths.zarr", paths, KeyedPaths, PATHS_SCHEMA)

    def _take_paths(self, scene: Scene) -> None:
        # A key that fits the signed integers of the store.
        key, most = name_key(scene.scenario_id) >> 1, SCENES_PER_UNIT[self._side]
        if len(self._paths) == most and key > max(self._paths):
            return
        try:
            self._paths[key] = read_paths(scene, TokenSettings())
        except TokensError:
            return  # ``tokenize`` names the scenes that cannot be written as tokens.
        if len(self._paths) > most:
            del self._paths[max(self._paths)]

    def _merge(self) -> None:
        most = self._settings.samples_per_shard
        if self._segments:
            self._segments = [merge_motion_samples(self._segments, most)]
        self._curves = [merge_map_samples(self._curves, most)]


def _gather(units: Sequence[FinishedUnit], side: str, settings: VocabSettings) -> _Gathered:
    """Merge one side's samples of all files, one file in memory at a time."""
    segments, curves, paths = NO_MOTION_SAMPLES, NO_MAP_SAMPLES, dict[int, Paths]()
    most = settings.samples_per_type
    for done in units:
        folder = done.path / side
        if not folder.is_dir():
            continue
        parts = _read(folder / "segments.zarr", MotionSamples, SEGMENTS_SCHEMA)
        segments = merge_motion_samples([segments, *parts], most)
        pieces = _read(folder / "curves.zarr", MapSamples, CURVES_SCHEMA)
        curves = merge_map_samples([curves, *pieces], most)
        scenes = _read(folder / "paths.zarr", KeyedPaths, PATHS_SCHEMA)
        paths |= {scene.key: scene.paths for scene in scenes}
        paths = {key: paths[key] for key in sorted(paths)[: SCENES_IN_ALL[side]]}
    return _Gathered(segments, curves, list(paths.values()))


def _held_out_words(units: Sequence[FinishedUnit], settings: VocabSettings) -> str:
    """Say in words what the coverage is measured on."""
    scenes = sum(done.report[HELD_OUT] for done in units)
    if any(done.report["role"] == HELD_OUT for done in units):
        return f"{scenes} scenes of split {settings.validation_split}"
    return (
        f"{scenes} scenes of split {settings.split}, held out by the hash of their id: "
        f"there is no split {settings.validation_split}"
    )


def _headline(report: dict[str, Any]) -> Report:
    """Pick the few figures that the run's log shows."""
    kinds = report["motion"].items()
    return {
        "scenes": report["scenes"][LEARN],
        "validation_split": report["validation_split"],
        "real": {kind: figures["real"] for kind, figures in kinds},
        "error_m": {
            kind: (figures["held_out_error_m"] or {}).get("mean") for kind, figures in kinds
        },
        "roads_real": report["roads"]["real"],
    }


def _write(path: Path, records: Sequence[Any], kind: type, schema: str) -> None:
    from pipeline.storage.zarr_store import write_records  # noqa: PLC0415

    write_records(path, records, kind, schema, compress=False)


def _read(path: Path, kind: type[T], schema: str) -> "PackedRecords[T]":
    from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

    return read_records(path, kind, schema, whole=True)


STAGE = Stage(
    name="build-vocab",
    version=2,
    settings={"build-vocab": VocabSettings},
    plan=plan,
    work=work,
    finish=finish,
    reads=reads,
    modules=(
        "pipeline.storage.duplicates",
        "pipeline.stages.vocabulary",
        "pipeline.stages.vocabulary_tables",
    ),
)
