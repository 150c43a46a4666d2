"""What the units of stage ``score`` wrote, of many at once.

A unit's tables are small, and there are thousands of units: to open them one by one takes
far longer than to read them. Polars reads those of some hundred units as one table, and
what is kept of it is arrays.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float32

from infgen.metrics.proper.split import part_sizes
from pipeline.engine.atomic import StoreError
from pipeline.stages.score.proper import PARTS
from pipeline.stages.score.summary import Means, add_sums
from pipeline.stages.score.write import SCENES

UNITS_AT_ONCE = 256
RANKS = "rank/"
"""How the names of the parts begin that are as long as a scene has rollouts."""


class ProperTable(NamedTuple):
    """Parts of all scenes by protocol ``proper``.

    Attributes:
        sizes: Number of values of each part.
        values: The parts of each scene side by side [scene, column].
    """

    sizes: dict[str, int]
    values: Float32[np.ndarray, "scene column"]

    def part(self, name: str) -> np.ndarray:
        """One part of each scene [scene, value]."""
        start = 0
        for each, size in self.sizes.items():
            if each == name:
                return self.values[:, start : start + size]
            start += size
        raise KeyError(name)


def read_means(folders: Sequence[Path]) -> Means:
    """Read the means of the scenes of some units.

    Raises:
        StoreError: if scenes have different metrics.
    """
    ids: list[str] = []
    names: list[str] = []
    blocks = []
    for table in _tables(folders, SCENES):
        scenes = _first_of_each(table["scenario_id"])
        if not len(scenes):
            continue
        shape = len(scenes), len(table) // len(scenes)
        names = names or table["metric"].head(shape[1]).to_list()
        if table["metric"].to_list() != names * shape[0]:
            raise StoreError(
                f"scenes in {folders[0].parent} have different metrics, expected "
                f"{', '.join(names)} of each; run stage score again"
            )
        ids += table["scenario_id"].gather(scenes).to_list()
        blocks.append(table["value"].to_numpy().reshape(shape))
    return Means(ids, names, np.concatenate(blocks) if blocks else np.empty((0, 0)))


def read_sums(folders: Sequence[Path], name: str) -> dict[str, np.ndarray]:
    """Add up the sums [value or count, window] by metric, in the order of the units.

    Args:
        folders: Of the units.
        name: Of the table in each.
    """
    found: dict[str, np.ndarray] = {}
    for table in _tables(folders, name):
        metrics = table["metric"].unique(maintain_order=True).to_list()
        which = table["metric"].cast(pl.Enum(metrics)).to_physical().to_numpy()
        window = table["window"].to_numpy().astype(np.int64)
        windows = int(window.max(initial=-1)) + 1
        place = which.astype(np.int64) * windows + window
        added = [
            np.bincount(place, table[column].to_numpy(), len(metrics) * windows)
            for column in ("value", "rollouts")
        ]
        sums = np.stack(added, axis=1).reshape(len(metrics), windows, 2)
        for metric, each in zip(metrics, sums, strict=True):
            found[metric] = add_sums(found.get(metric, np.empty((2, 0))), each.T)
    return found


def read_proper_table(folders: Sequence[Path]) -> ProperTable:
    """Read the parts of the scenes of some units; ranks of fewer rollouts end in zeros."""
    blocks = [
        block for table in _tables(folders, PARTS) for block in _blocks_of_parts(table)
    ]
    ranks = [size for sizes, _ in blocks for name, size in sizes.items() if _ranks(name)]
    sizes = part_sizes(max(ranks, default=1))
    ends = np.cumsum([0, *sizes.values()]).tolist()
    starts = dict(zip(sizes, ends, strict=False))
    values = np.zeros((sum(len(block) for _, block in blocks), ends[-1]), np.float32)
    row = 0
    for found, block in blocks:
        column, rows = 0, slice(row, row + len(block))
        for name, size in found.items():
            into = slice(starts[name], starts[name] + size)
            values[rows, into] = block[:, column : column + size]
            column += size
        row += len(block)
    return ProperTable(sizes, values)


def _blocks_of_parts(table: pl.DataFrame) -> Iterator[tuple[dict[str, int], np.ndarray]]:
    """Parts of scenes that follow each other and are equally long, side by side."""
    if not len(table):
        return
    lengths = table["values"].list.len().to_numpy()
    values = table["values"].explode().drop_nulls().to_numpy()
    starts = _first_of_each(table["scenario_id"])
    names, parts = table["part"].to_list(), len(table) // len(starts)
    sizes = lengths.reshape(len(starts), parts)
    differ = np.flatnonzero((sizes[1:] != sizes[:-1]).any(axis=1)) + 1
    ends = np.cumsum(sizes.sum(axis=1))
    for first, after in zip([0, *differ], [*differ, len(starts)], strict=True):
        begin = ends[first - 1] if first else 0
        block = values[begin : ends[after - 1]].reshape(after - first, -1)
        yield dict(zip(names[:parts], sizes[first].tolist(), strict=True)), block


def _ranks(name: str) -> bool:
    return name.startswith(RANKS)


def _first_of_each(ids: pl.Series) -> np.ndarray:
    """Rows where another scene begins; all rows of a scene lie together."""
    return np.flatnonzero((ids != ids.shift()).fill_null(value=True).to_numpy())


def _tables(folders: Sequence[Path], name: str) -> Iterator[pl.DataFrame]:
    """Read a table of some units as one, some hundred units at a time."""
    for first in range(0, len(folders), UNITS_AT_ONCE):
        paths = [folder / name for folder in folders[first : first + UNITS_AT_ONCE]]
        yield pl.read_parquet(paths)
