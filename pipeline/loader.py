"""Token shards to batches: mapped into memory, shuffled by step, prepared one ahead.

What a step reads follows from (seed, step) alone, so there is no position to save.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np

from infgen.model.batch import Batch, Limits, collate
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.tokenize import open_tokens

T = TypeVar("T")

AHEAD = 2
"""Batches prepared before they are asked for."""


class TokenScenes(Sequence[SceneTokens]):
    """All scenes of some token shards; nothing is read before it is used."""

    def __init__(self, units: Sequence[Path]) -> None:
        self._groups = [group for unit in units for group in open_tokens(unit)]
        self._ends = np.cumsum([0, *(len(group) for group in self._groups)])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, row):  # type: ignore[no-untyped-def]
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        if not 0 <= row < len(self):
            raise IndexError(f"scene {row} of {len(self)}")
        group = int(np.searchsorted(self._ends, row, side="right")) - 1
        return self._groups[group][row - int(self._ends[group])]


def scenes_of_step(step: int, batch: int, count: int, seed: int) -> list[int]:
    """Scenes of one step: every epoch is a permutation of all, keyed by (seed, epoch).

    A batch may end one epoch and begin the next.
    """
    places = range(step * batch, (step + 1) * batch)
    epochs = sorted({place // count for place in places})
    orders = {
        epoch: np.random.default_rng([seed, epoch]).permutation(count) for epoch in epochs
    }
    return [int(orders[place // count][place % count]) for place in places]


def draw_of_step(step: int, seed: int) -> int:
    """Number that decides how the scenes of one step are looked at."""
    return (seed << 40) + step


def train_batches(
    scenes: Sequence[SceneTokens], limits: Limits, batch: int, seed: int, steps: range
) -> Iterator[Batch]:
    """Yield the batch of every step, prepared ahead in a thread."""

    def make(step: int) -> Batch:
        rows = scenes_of_step(step, batch, len(scenes), seed)
        return collate([scenes[row] for row in rows], limits, draw_of_step(step, seed))

    with ThreadPoolExecutor(1, thread_name_prefix="loader") as pool:
        waiting: list[Future[Batch]] = []
        for step in steps:
            waiting.append(pool.submit(make, step))
            if len(waiting) > AHEAD:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()


def held_out_batches(
    scenes: Sequence[SceneTokens], limits: Limits, batch: int, seed: int, count: int
) -> Iterator[Batch]:
    """Yield batches of so many held-out scenes, the same each time."""
    rows = np.random.default_rng([seed]).permutation(len(scenes))[:count]
    for at in range(0, len(rows), batch):
        chosen = [scenes[int(row)] for row in rows[at : at + batch]]
        yield collate(chosen, limits, draw=at)
