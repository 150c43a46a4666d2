"""Which scenes each training step reads: a function of (seed, step), so nothing is saved.

Every epoch is a permutation of all scenes. So many batches of it at a time are a pool:
sorted by size, cut, and put in another order, so that a batch holds scenes of about one
size and padding is small. Scenes have two sizes, agents and roads, that have little to do
with each other: a pool is cut into strips by the one, and within a strip sorted by the
other. A batch that begins in one epoch and ends in the next is mixed; no scene is lost or
read twice.

Where sources have shares (``Mixture``), an epoch is a round of draws: of each source as
many as its share says, the next ones of permutations of its own scenes.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Int64

_CHOICE = 1 << 31
"""In place of an epoch: which scenes are read at all."""


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """How often scenes of each source are read.

    Attributes:
        rows: Scenes of each source, at least one.
        counts: Of each source, how many a round has.
    """

    rows: tuple[Int64[np.ndarray, " _"], ...]
    counts: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ScenePermutation:
    """The order in which scenes are read.

    Attributes:
        size: What decides which scenes go together: of every scene, two sizes.
        batch: Scenes of a step.
        pool: Batches that are sorted together; 1 to leave scenes as they are drawn.
        seed: Of all permutations.
        mixture: Shares of the sources; None for every scene once an epoch.
        most: How many scenes are read at all, if there are more; 0 for all. Without
            ``mixture`` only.
        skip: Steps that are left out at the beginning.
    """

    size: Int64[np.ndarray, "scene 2"]
    batch: int
    pool: int
    seed: int
    mixture: Mixture | None = None
    most: int = 0
    skip: int = 0

    @property
    def epoch_scenes(self) -> int:
        """Scenes of an epoch."""
        return sum(self.mixture.counts) if self.mixture else len(self.rows)

    @property
    def rows(self) -> Int64[np.ndarray, " row"]:
        """Scenes that are read where no source has a share, ascending."""
        if not 0 < self.most < len(self.size):
            return np.arange(len(self.size))
        random = np.random.default_rng([self.seed, _CHOICE])
        return np.sort(random.permutation(len(self.size))[: self.most])

    def scenes(self, step: int) -> list[int]:
        """Rows of the scenes of one step."""
        count, first = self.epoch_scenes, (self.skip + step) * self.batch
        places = range(first, first + self.batch)
        return [int(_rows_of_epoch(self, at // count)[at % count]) for at in places]


@lru_cache(maxsize=4)
def _rows_of_epoch(order: ScenePermutation, epoch: int) -> np.ndarray:
    """All scenes in the order of one epoch; what is cut at its ends stays as drawn."""
    random = np.random.default_rng([order.seed, epoch])
    rows = random.permutation(_drawn(order, epoch))
    begins = -epoch * len(rows) % order.batch  # Ends the batch that the last epoch began.
    whole = max(0, (len(rows) - begins) // order.batch)
    if order.pool == 1 or not whole:
        return rows
    inner = slice(begins, begins + whole * order.batch)
    rows[inner] = _bucketed(order, rows[inner], random).ravel()
    return rows


def _drawn(order: ScenePermutation, epoch: int) -> np.ndarray:
    """All scenes of one epoch, in no order."""
    if order.mixture is None:
        return order.rows
    drawn = []
    for source, (rows, count) in enumerate(
        zip(order.mixture.rows, order.mixture.counts, strict=True)
    ):
        first, skip = divmod(epoch * count, len(rows))
        passes = range(first, first + -(-(skip + count) // len(rows)))
        own = [np.random.default_rng([order.seed, source, each]) for each in passes]
        read = np.concatenate([rows[random.permutation(len(rows))] for random in own])
        drawn.append(read[skip : skip + count])
    return np.concatenate(drawn)


def _bucketed(
    order: ScenePermutation, rows: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Batches of scenes of about one size, in any order [batch, scene]."""
    alike = []
    for pool in _cut(rows, order.pool * order.batch):
        by_second = pool[np.argsort(order.size[pool, 1], kind="stable")]
        strips = round(math.sqrt(len(pool) / order.batch))
        for strip in _cut(by_second, -(-len(pool) // (strips * order.batch)) * order.batch):
            alike.append(strip[np.argsort(order.size[strip, 0], kind="stable")])
    batches = np.concatenate(alike).reshape(-1, order.batch)
    return batches[random.permutation(len(batches))]


def _cut(rows: np.ndarray, length: int) -> list[np.ndarray]:
    """Cut rows into pieces of a length, and what is left."""
    return np.split(rows, range(length, len(rows), length))
