"""Boxes that do not move: [x, y, heading, length, width, height]."""

import numpy as np
from jaxtyping import Bool, Float64

from infgen.geometry import SQUARES_PER_COLUMN, boxes_overlap, grid_squares

Boxes = Float64[np.ndarray, "_ 6"]

_CELL_M = 10.0
"""Bodies whose middles are farther apart do not meet parked cars."""


def meet(
    boxes: Float64[np.ndarray, "box 6"], others: Float64[np.ndarray, "other 6"]
) -> Bool[np.ndarray, "box other"]:
    """Which boxes overlap which others."""
    shape = (len(boxes), len(others))
    return boxes_overlap(
        np.broadcast_to(boxes[:, None, :3], (*shape, 3)),
        np.broadcast_to(boxes[:, None, 3:5], (*shape, 2)),
        np.broadcast_to(others[:, :3], (*shape, 3)),
        np.broadcast_to(others[:, 3:5], (*shape, 2)),
    )


def clear_way(
    parked: Boxes,
    pose: Float64[np.ndarray, "body 3"],
    size_lw_m: Float64[np.ndarray, "body 2"],
) -> Boxes:
    """Take away parked cars that stand in the way of somebody, wherever they come by."""
    cells = grid_squares(parked[:, :2], _CELL_M)
    number = grid_squares(pose[:, :2], _CELL_M)
    order = np.argsort(number, kind="stable")
    number = number[order]
    # Three runs of consecutive numbers hold all nine squares around one.
    columns = cells[:, None] + SQUARES_PER_COLUMN * np.array([-1, 0, 1])
    start = np.searchsorted(number, columns - 1, side="left")
    stop = np.searchsorted(number, columns + 1, side="right")
    met = np.zeros(len(parked), bool)
    for row, box in enumerate(parked):
        runs = [order[slice(*run)] for run in zip(start[row], stop[row], strict=True)]
        around = np.concatenate(runs)
        near = around[np.abs(pose[around, :2] - box[:2]).max(axis=1) < _CELL_M]
        bodies = np.column_stack([pose[near], size_lw_m[near], np.zeros(len(near))])
        met[row] = meet(box[None], bodies).any()
    return parked[~met]
