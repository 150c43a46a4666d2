"""Token shards to batches: read scene by scene, in any order, prepared ahead of time.

What a step reads follows from (seed, step) alone, so there is no position to save, and it
does not depend on what prepares it: a thread, or any number of processes.
"""

import multiprocessing
import signal
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Int64
from torch.utils.data import DataLoader, Dataset

from infgen.model.batching.batch import Batch, Limits, collate
from infgen.model.batching.perturbation import Perturbation
from infgen.model.device.packed import PackedBatch
from infgen.tokens.scene_tokens import SceneTokens
from pipeline.stages.tokenize import open_tokens
from pipeline.stages.train.sampler import ScenePermutation

T = TypeVar("T")
Made = Batch | PackedBatch

AHEAD = 2
"""Batches prepared ahead."""


class TokenScenes(Sequence[SceneTokens]):
    """All scenes of some token shards; nothing is read before it is used."""

    def __init__(self, units: Sequence[Path]) -> None:
        self._units = tuple(units)
        by_shard = [open_tokens(unit) for unit in units]
        self._groups = [group for groups in by_shard for group in groups]
        self._shard_sizes = [sum(map(len, groups)) for groups in by_shard]
        self._ends = np.cumsum([0, *(len(group) for group in self._groups)])

    def __reduce__(self):  # type: ignore[no-untyped-def]
        """Travel to another process as paths, not as data."""
        return type(self), (self._units,)

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, row):  # type: ignore[no-untyped-def]
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        if not 0 <= row < len(self):
            raise IndexError(f"scene {row} of {len(self)}")
        group = int(np.searchsorted(self._ends, row, side="right")) - 1
        return self._groups[group][row - int(self._ends[group])]

    @property
    def shard_sizes(self) -> list[int]:
        """Number of scenes of each shard."""
        return self._shard_sizes

    def sizes(self, limits: Limits) -> Int64[np.ndarray, "scene 2"]:
        """Sizes of every scene within the limits: agents x tokens, and roads.

        Known from the shards' own tables; no scene is read.
        """
        agents = self._counts("agent").clip(max=limits.agents)
        tokens = self._counts("token").clip(max=limits.tokens)
        roads = self._counts("map_token").clip(max=limits.roads)
        return np.column_stack([agents * tokens, roads])

    def _counts(self, dim: str) -> np.ndarray:
        parts = [np.asarray(group.sizes(dim), np.int64) for group in self._groups]
        return np.concatenate([np.empty(0, np.int64), *parts])


def draw_of_step(step: int, seed: int) -> int:
    """Number that decides how the scenes of one step are looked at."""
    return (seed << 40) + step


@dataclass(frozen=True, slots=True)
class Recipe(Dataset[list[Made]]):
    """How the batch of a step is made.

    Attributes:
        scenes: All there are.
        limits: How much of each a batch holds.
        order: Which of them a step reads.
        parts: Parts that the batch of a step is cut into ...
        own: ... and which of them are made.
        noise: How the scenes' tokens are disturbed; None for scenes as they are.
        packed: Whether batches are made ready to be copied to a GPU.
    """

    scenes: Sequence[SceneTokens]
    limits: Limits
    order: ScenePermutation
    parts: int = 1
    own: range = range(1)
    noise: Perturbation | None = None
    packed: bool = False

    def __getitem__(self, step: int) -> list[Made]:
        """Make the own parts of the batch of one step."""
        draw = draw_of_step(self.order.skip + step, self.order.seed)
        scenes = [[self.scenes[row] for row in self.rows(step, part)] for part in self.own]
        made = [collate(part, self.limits, draw, self.noise) for part in scenes]
        return [PackedBatch.of(batch) for batch in made] if self.packed else [*made]

    def rows(self, step: int, part: int) -> list[int]:
        """Scenes of one part; all parts are of about one size."""
        return self.order.scenes(step)[part :: self.parts]


def train_batches(
    recipe: Recipe, steps: range, workers: int
) -> Generator[list[Made], None, None]:
    """Yield the own parts of every step's batch, prepared ahead.

    Args:
        recipe: How they are made.
        steps: Of which steps.
        workers: Processes that make them; 0 for a thread of this one. A thread costs
            nothing to start, and hands batches over for nothing.
    """
    if workers:
        made = made_by_processes(recipe, steps, workers)
    else:
        made = map(recipe.__getitem__, steps)
    yield from _prefetched(map(_pin, made))


def made_by_processes(recipe: Recipe, steps: range, workers: int) -> Iterator[list[Made]]:
    """Make the batches of some steps in processes of their own."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # Torch is imported once, not by each.
    loader = DataLoader(
        recipe,
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        worker_init_fn=_leave_signals_to_the_parent,
        multiprocessing_context=context,
        generator=torch.Generator(),  # Else it would draw from the global one.
    )
    return iter(loader)


def _leave_signals_to_the_parent(number: int) -> None:
    """Let the parent decide when a run ends: it has a checkpoint to write first."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)


def _prefetched(made: Iterator[T]) -> Iterator[T]:
    """Take values in a thread, some ahead of the consumer."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="loader")
    try:
        waiting = [pool.submit(_take, made) for _ in range(AHEAD)]
        while found := waiting.pop(0).result():
            waiting.append(pool.submit(_take, made))
            yield found[0]
    finally:
        pool.shutdown(cancel_futures=True)


def _take(made: Iterator[T]) -> list[T]:
    """Take the next value; nothing at the end."""
    return list(islice(made, 1))


def _pin(parts: list[Made]) -> list[Made]:
    """Put what goes to a GPU in memory that it can copy from by itself."""
    return [part.pin() if isinstance(part, PackedBatch) else part for part in parts]


def validation_batches(
    scenes: Sequence[SceneTokens], limits: Limits, batch: int, seed: int, count: int
) -> Iterator[Batch]:
    """Yield batches of so many held-out scenes, seen the same however they are cut."""
    rows = np.random.default_rng([seed]).permutation(len(scenes))[:count]
    for at in range(0, len(rows), batch):
        chosen = [scenes[int(row)] for row in rows[at : at + batch]]
        yield collate(chosen, limits, draw=0)
