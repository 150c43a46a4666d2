"""k-disks: cover items with disks of one radius, and take the mean of each (SPEC 2.1).

An item stands for a few points (the corners of a box where a motion token ends; the points
of a line). Two items are as far apart as their points are on average. A disk is all free
items within the tolerance of a seed. Its mean becomes a centre, unless it stands within the
tolerance of an earlier one or is no allowed item; then the member nearest to the mean does.
Items within the tolerance of a centre are free no longer, so members are far enough.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64

Items = np.ndarray
"""Items [item, ...] of one space, float32."""


@runtime_checkable
class Space(Protocol):
    """What k-disks must know of its items."""

    def points_m(self, items: Items) -> Float64[np.ndarray, "item point 2"]:
        """Return the points that items are compared by."""

    def mean(self, items: Items) -> Items:
        """Return the mean of items, as one item."""

    def allowed(self, items: Items) -> Bool[np.ndarray, " item"]:
        """Tell which items may be centres."""


def find_disks(
    space: Space,
    items: Items,
    order: Int64[np.ndarray, " item"],
    tolerance_m: float,
    count: int,
    taken: Items,
    *,
    average: bool = True,
) -> Items:
    """Cover items with at most ``count`` disks and return their centres, as laid.

    Args:
        space: What the items are.
        items: What to cover; all are allowed.
        order: Rows of ``items`` in the order in which they may become seeds.
        tolerance_m: Radius of a disk. No two centres are closer, nor is any to ``taken``.
        count: Most centres.
        taken: Centres that there are already.
        average: Let means stand for disks; else seeds do.
    """
    pool = _SortedItems(space.points_m(items))
    laid_m = np.empty((len(taken) + count, *pool.points_m.shape[1:]))
    laid_m[: len(taken)] = space.points_m(taken)
    free = np.ones(len(items), dtype=bool)
    for point_m in laid_m[: len(taken)]:
        free[pool.near(point_m, tolerance_m)] = False

    centres: list[Items] = []
    for seed in order:
        if len(centres) == count:
            break
        if not free[seed]:
            continue
        disk = pool.near(pool.points_m[seed], tolerance_m)
        members = items[disk[free[disk]]]
        used = len(taken) + len(centres)
        centre = items[seed]
        if average:
            centre = _disk_centre(space, members, laid_m[:used], tolerance_m)
        laid_m[used] = space.points_m(centre[None])[0]
        free[disk] = False
        free[pool.near(laid_m[used], tolerance_m)] = False
        centres.append(centre)
    return np.array(centres, dtype=np.float32).reshape(-1, *items.shape[1:])


def mean_gap_m(
    points_m: Float64[np.ndarray, "*rows point 2"], point_m: Float64[np.ndarray, "point 2"]
) -> Float64[np.ndarray, "*rows"]:
    """Return how far items are from one: the mean distance of their points."""
    away_m = points_m - point_m
    return np.sqrt(away_m[..., 0] ** 2 + away_m[..., 1] ** 2).mean(axis=-1)


class _SortedItems:
    """Items sorted along one axis, so that only a strip of them need be measured.

    The centroids of two items are never farther apart than the items are.
    """

    def __init__(self, points_m: np.ndarray) -> None:
        centroid_m = points_m.mean(axis=1)  # [item, 2]
        self.axis = int(centroid_m.std(axis=0).argmax()) if len(points_m) else 0
        self.row = np.argsort(centroid_m[:, self.axis], kind="stable")
        self.along_m = centroid_m[self.row, self.axis]
        self.points_m = points_m
        self._sorted_m = points_m[self.row]

    def near(self, point_m: np.ndarray, within_m: float) -> np.ndarray:
        """Return the rows of items within a distance of one."""
        middle_m = point_m[:, self.axis].mean()
        reach_m = within_m * (1 + 1e-9)
        strip = slice(
            self.along_m.searchsorted(middle_m - reach_m),
            self.along_m.searchsorted(middle_m + reach_m, side="right"),
        )
        return self.row[strip][mean_gap_m(self._sorted_m[strip], point_m) <= within_m]


def _disk_centre(
    space: Space, members: Items, laid_m: np.ndarray, tolerance_m: float
) -> Items:
    """Return the mean of a disk if it may be a centre, else the member nearest to it."""
    mean = space.mean(members)
    mean_m = space.points_m(mean[None])[0]
    if space.allowed(mean[None])[0] and (mean_gap_m(laid_m, mean_m) > tolerance_m).all():
        return mean
    nearest = mean_gap_m(space.points_m(members), mean_m).argmin()
    return members[nearest]
