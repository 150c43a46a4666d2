"""Roots of any number of scenes, with true metadata and the payload of one shard a split.

The first unit of every split is made by its stage itself. Every other unit is a copy of it
under its own key: tables, reports and manifests tell its own scenes, and large arrays are
links to those of the first. Folders of whole stages are made by the pipeline from these
units, as a run does that was killed at its very end.
"""

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import google_crc32c
import polars as pl

from infgen.scene import Scene
from infgen.sources.tfrecord import frame
from infgen.sources.womd_write import encode_scenario
from pipeline.engine.atomic import MANIFEST
from pipeline.engine.inputs import FinishedInputs
from pipeline.engine.layout import RUN
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import Plan
from pipeline.engine.tasks import make_tasks
from pipeline.engine.units import Task, do
from pipeline.settings.request import Request
from pipeline.storage.splits import split_of

ID_DIGITS, ROW_DIGITS = 16, 8
SETTINGS = {
    "ingest.max_scenes_per_file": 0,
    "tokenize.insertion_distance_m": 75,
    "train.steps": 1,
    "train.checkpoint_every_steps": 0,
    "calibrate.method": "none",
    "rollout.max_scenes": 0,
}
"""Laid over profile ``tiny``: all scenes."""
_REWRITTEN = (".parquet", ".json")
SCORE, HIGHER = "value", 1.0
"""Scores are higher in copies: a report shows the rollouts with the lowest, and only those
of the first unit go by its names in their arrays too."""
Names = Sequence[tuple[str, str]]
"""What is called otherwise in a copy: (there, here)."""


@dataclass(frozen=True, slots=True)
class Census:
    """How large a root is.

    Attributes:
        files: Records of each split.
        scenes_per_file: Scenes of each; in the validation split a multiple of a unit's.
        scenes_per_unit: Scenes that are simulated by one unit.
        rollouts: Of each scene of the validation split.
        seconds: Length of a rollout.
    """

    files: Mapping[str, int]
    scenes_per_file: Mapping[str, int]
    scenes_per_unit: int = 8
    rollouts: int = 32
    seconds: float = 30.0

    @property
    def settings(self) -> list[str]:
        """Words of ``-s``."""
        sizes = {
            "rollout.count": self.rollouts,
            "rollout.seconds": self.seconds,
            "rollout.scenes_per_unit": self.scenes_per_unit,
        }
        return [f"{name}={value}" for name, value in (SETTINGS | sizes).items()]


def scenario_id(split: str, file: int, record: int) -> str:
    """Id of a scene, from its place; none holds the start of another."""
    return f"{split[0]}{file:07x}{record:0{ROW_DIGITS}x}"


def write_records(folder: Path, census: Census, scene: Scene) -> None:
    """Write TFRecords: whole scenes in the first of each split, a few bytes in the others.

    Stages only ever decode those of the first, and the probe of ``plan --preset`` takes
    usable ones only; fingerprints tell all of them apart.
    """
    folder.mkdir(parents=True)
    blank = b"x" * ID_DIGITS
    placed = encode_scenario(replace(scene, scenario_id=blank.decode()))
    for split, files in census.files.items():
        for file in range(files):
            content = blank if file else placed
            records = (
                content.replace(blank, scenario_id(split, file, row).encode(), 1)
                for row in range(census.scenes_per_file[split])
            )
            path = folder / f"{split}.tfrecord-{file:05d}-of-{files:05d}"
            path.write_bytes(b"".join(frame(record) for record in records))


def populate(request: Request, plan: Plan, stage: str, scenes_per_unit: int) -> int:
    """Make all units of a stage whose inputs are whole; returns how many.

    Args:
        request: Whose root it is.
        plan: Its plan.
        stage: The stage.
        scenes_per_unit: Scenes that are simulated by one unit.
    """
    planned = plan[stage]
    units = planned.stage.plan(FinishedInputs(request.root, planned), planned.settings)
    tasks = make_tasks(request.root, planned, units)
    request.root.units(stage).mkdir(parents=True, exist_ok=True)
    first: dict[tuple[str, bool], _Template] = {}
    for task in tasks:
        # Stage ``score`` has units of whole files, and of some scenes of a file.
        kind = split_of(task.unit.name), "rollouts" in task.unit.task
        template = first.get(kind)
        if template is None:
            do(task, _say_nothing)
            first[kind] = _Template(task, scenes_per_unit)
        else:
            template.copy(task)
    return len(tasks)


def _say_nothing(done: float, total: float, note: str = "") -> None:
    """Report no progress."""


class _Template:
    """A unit that a stage made, to be copied."""

    def __init__(self, task: Task, scenes_per_unit: int) -> None:
        self._unit, self._folder = task.unit.name, task.target
        self._scenes = scenes_per_unit
        manifest = read_manifest(task.target)
        self._report = json.dumps(manifest["report"])
        self._files: dict[str, list[Any]] = manifest["files"]
        self._run = (task.target / RUN).read_bytes()
        self._texts = {
            name: (task.target / name).read_text()
            for name in self._files
            if name.endswith(".json")
        }
        self._tables = {
            name: pl.read_parquet(task.target / name)
            for name in self._files
            if name.endswith(".parquet")
        }

    def copy(self, task: Task) -> None:
        """Make another unit like it, with its own names."""
        ids = (_starts_of_ids(unit, self._scenes) for unit in (self._unit, task.unit.name))
        names = [(self._unit, task.unit.name), *zip(*ids, strict=True)]
        task.target.mkdir()
        files = dict(self._files)
        for name, data in self._rewritten(names):
            path = task.target / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            files[name] = [len(data), f"{google_crc32c.value(data):08x}"]
        for name in files:
            if not name.endswith(_REWRITTEN):
                path = task.target / name
                path.parent.mkdir(parents=True, exist_ok=True)
                os.link(self._folder / name, path)
        report = json.loads(_renamed(self._report, names))
        about = {**task.about, "report": report, "files": files}
        (task.target / RUN).write_bytes(self._run)
        text = json.dumps(about, indent=1, sort_keys=True) + "\n"
        (task.target / MANIFEST).write_text(text)

    def _rewritten(self, names: Names) -> Iterator[tuple[str, bytes]]:
        """Files that hold names."""
        for name, text in self._texts.items():
            yield name, _renamed(text, names).encode()
        for name, table in self._tables.items():
            buffer = io.BytesIO()
            _renamed_table(table, names).write_parquet(buffer)
            yield name, buffer.getvalue()


def _starts_of_ids(unit: str, scenes: int) -> list[str]:
    """How the ids of a unit's scenes begin, in order.

    Examples:
        ``validation.tfrecord-00003-of-00150`` is a file, and all its ids begin alike;
        followed by ``-00008`` it is the unit of some of its scenes, from that one on.
    """
    file, _, _, *first = unit.split(".tfrecord-")[1].split("-")
    whole = partial(scenario_id, split_of(unit), int(file))
    if not first:
        return [whole(0)[: ID_DIGITS - ROW_DIGITS]]
    return [whole(row) for row in range(int(first[0]), int(first[0]) + scenes)]


def _renamed(text: str, names: Names) -> str:
    for there, here in names:
        text = text.replace(there, here)
    return text


def _renamed_table(table: pl.DataFrame, names: Names) -> pl.DataFrame:
    """Rename in all columns of text, each different word once."""
    columns = []
    for name, kind in table.schema.items():
        if kind == pl.String:
            words = table[name].unique().to_list()
            new = {word: _renamed(word, names) for word in words if word is not None}
            columns.append(pl.col(name).replace(new))
    if SCORE in table.columns and "rollout" in table.columns:
        columns.append(pl.col(SCORE) + HIGHER)
    return table.with_columns(columns)
