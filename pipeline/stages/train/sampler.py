"""Which scenes each training step reads: a function of (seed, step), so nothing is saved.

Every epoch is a permutation of all scenes. So many batches of it at a time are a pool:
sorted by size, cut, and put in another order, so that a batch holds scenes of about one
size and padding is small. Scenes have two sizes, agents and roads, that have little to do
with each other: a pool is cut into strips by the one, and within a strip sorted by the
other. A batch that begins in one epoch and ends in the next is mixed; no scene is lost or
read twice.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Int64


@dataclass(frozen=True, slots=True, eq=False)
class ScenePermutation:
    """The order in which scenes are read.

    Attributes:
        size: What decides which scenes go together: of every scene, two sizes.
        batch: Scenes of a step.
        pool: Batches that are sorted together; 1 to leave scenes as they are drawn.
        seed: Of all permutations.
    """

    size: Int64[np.ndarray, "scene 2"]
    batch: int
    pool: int
    seed: int

    def scenes(self, step: int) -> list[int]:
        """Rows of the scenes of one step."""
        count = len(self.size)
        places = range(step * self.batch, (step + 1) * self.batch)
        return [int(_rows_of_epoch(self, at // count)[at % count]) for at in places]


@lru_cache(maxsize=4)
def _rows_of_epoch(order: ScenePermutation, epoch: int) -> np.ndarray:
    """All scenes in the order of one epoch; what is cut at its ends stays as drawn."""
    random = np.random.default_rng([order.seed, epoch])
    rows = random.permutation(len(order.size))
    begins = -epoch * len(rows) % order.batch  # Ends the batch that the last epoch began.
    whole = max(0, (len(rows) - begins) // order.batch)
    if order.pool == 1 or not whole:
        return rows
    inner = slice(begins, begins + whole * order.batch)
    rows[inner] = _bucketed(order, rows[inner], random).ravel()
    return rows


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
