"""Stage ``tokenize``: scenes and vocabularies to tokens that training reads scene by scene.

One unit per ingested file. Groups are uncompressed, and each scene lies in one piece, to be
read at once. A scene that cannot be written as tokens is a named row of
``refused.parquet``.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from infgen.config import TokenSettings
from infgen.scene import Scene
from infgen.tokens.scene_tokens import SceneTokens
from infgen.tokens.statistics import TokenStatistics, count, describe, no_statistics
from infgen.tokens.tokenizer import tokenize_scene
from infgen.tokens.tracks import TokensError
from pipeline.engine.atomic import write_json
from pipeline.engine.stage import FinishedUnit, Inputs, Progress, Report, Stage, Unit
from pipeline.storage.duplicates import read_task_scenes, scenes_task
from pipeline.storage.parquet import make_table, read_tables
from pipeline.storage.splits import split_of

if TYPE_CHECKING:
    from pipeline.storage.whole_records import WholeRecords

SCHEMA = "infgen.tokens/3"
SCENES_PER_GROUP = 500
VOCABULARIES = ("motion.zarr", "roads.zarr")

_INDEX = {
    "scenario_id": str,
    "split": str,
    "unit": str,
    "group": str,
    "row": int,
    "agents": int,
    "tokens": int,
    "roads": int,
    "words": int,
    "entries": int,
}
_REFUSED = {"scenario_id": str, "split": str, "unit": str, "reason": str}


def open_tokens(unit_folder: Path) -> "list[WholeRecords[SceneTokens]]":
    """Open the tokens of one unit, group by group; nothing of them is read yet.

    Raises:
        StoreError: if a group is damaged.
    """
    from pipeline.storage.whole_records import read_whole_records  # noqa: PLC0415

    return [
        read_whole_records(path, SceneTokens, SCHEMA)
        for path in sorted(unit_folder.glob("tokens-*.zarr"))
    ]


def plan(inputs: Inputs, settings: TokenSettings) -> list[Unit]:
    """One unit per ingested file."""
    vocabularies = inputs.folder("build-vocab")
    identity = inputs.content("build-vocab", *VOCABULARIES)
    return [
        Unit(
            name=done.name,
            inputs={"scenes": done.key, "vocabularies": identity},
            task={**scenes_task(done), "vocabularies": str(vocabularies)},
        )
        for done in inputs.units("ingest")
    ]


def work(unit: Unit, target: Path, settings: TokenSettings, progress: Progress) -> Report:
    """Tokenize the scenes of one ingested file."""
    from pipeline.stages.vocabulary import load_vocabularies  # noqa: PLC0415

    target.mkdir(parents=True, exist_ok=True)
    motion, roads = load_vocabularies(Path(unit.task["vocabularies"]))
    shard = _Shard(target, unit.name)
    for scene in read_task_scenes(unit.task):
        try:
            shard.keep(scene, tokenize_scene(scene, motion, roads, settings))
        except TokensError as error:
            shard.refuse(scene, str(error))
    shard.close()
    return shard.report()


def finish(
    inputs: Inputs,
    units: Sequence[FinishedUnit],
    target: Path,
    settings: TokenSettings,
    progress: Progress,
) -> Report:
    """Join the units' tables, and write what the tokens add up to, split by split."""
    target.mkdir(parents=True, exist_ok=True)
    paths = [done.path for done in units]
    for name, columns in (("index", _INDEX), ("refused", _REFUSED)):
        read_tables(paths, f"{name}.parquet", columns).write_parquet(
            target / f"{name}.parquet"
        )
    splits = {split_of(done.name): no_statistics() for done in units}
    for done in units:
        splits[split_of(done.name)] += _read_figures(done.path)
    write_json(
        target / "report.json",
        {split: describe(figures) for split, figures in sorted(splits.items())},
    )
    return {
        "scenes": sum(done.report["scenes"] for done in units),
        "refused": sum(done.report["refused"] for done in units),
        "words": sum(done.report["words"] for done in units),
    }


class _Shard:
    """The tokens of one file on their way to disk."""

    def __init__(self, target: Path, unit: str) -> None:
        self._target, self._unit, self._split = target, unit, split_of(unit)
        self._pending: list[SceneTokens] = []
        self._index: list[dict[str, Any]] = []
        self._refused: list[dict[str, Any]] = []
        self._figures = no_statistics()
        self._groups = 0

    def keep(self, scene: Scene, tokens: SceneTokens) -> None:
        """Take one tokenized scene."""
        self._index.append(
            {
                "scenario_id": tokens.scenario_id,
                "split": self._split,
                "unit": self._unit,
                "group": self._group_name,
                "row": len(self._pending),
                "agents": tokens.num_agents,
                "tokens": tokens.num_tokens,
                "roads": tokens.num_map_tokens,
                "words": len(tokens.sequence_type),
                "entries": len(tokens.insertion_agent),
            }
        )
        self._figures += count(scene, tokens)
        self._pending.append(tokens)
        if len(self._pending) == SCENES_PER_GROUP:
            self._flush()

    def refuse(self, scene: Scene, reason: str) -> None:
        """Name a scene that cannot be tokenized."""
        row = (scene.scenario_id, self._split, self._unit, reason)
        self._refused.append(dict(zip(_REFUSED, row, strict=True)))

    def close(self) -> None:
        """Write what is left, the tables and the figures."""
        self._flush()
        make_table(self._index, _INDEX).write_parquet(self._target / "index.parquet")
        make_table(self._refused, _REFUSED).write_parquet(self._target / "refused.parquet")
        figures = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in asdict(self._figures).items()
        }
        write_json(self._target / "figures.json", figures)

    def report(self) -> Report:
        """Sum up the unit."""
        return {
            "split": self._split,
            "scenes": len(self._index),
            "refused": len(self._refused),
            "agents": int(self._figures.agents.sum()),
            "words": self._figures.words,
        }

    @property
    def _group_name(self) -> str:
        return f"tokens-{self._groups:03d}.zarr"

    def _flush(self) -> None:
        from pipeline.storage.whole_records import write_whole_records  # noqa: PLC0415

        if not self._pending:
            return
        path = self._target / self._group_name
        write_whole_records(path, self._pending, SceneTokens, SCHEMA)
        self._pending = []
        self._groups += 1


def _read_figures(unit_folder: Path) -> TokenStatistics:
    values: dict[str, Any] = json.loads((unit_folder / "figures.json").read_text())
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = np.array(value, np.int64)
    return TokenStatistics(**values)


STAGE = Stage(
    name="tokenize",
    version=3,
    settings={"tokenize": TokenSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=(
        "pipeline.storage.columns",
        "pipeline.storage.duplicates",
        "pipeline.storage.whole_records",
        "pipeline.storage.zarr_store",
        "pipeline.stages.tokenize",
    ),
)
