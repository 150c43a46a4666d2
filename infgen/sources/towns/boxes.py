"""Boxes that do not move: [x, y, heading, length, width, height]."""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from infgen.geometry import boxes_overlap

Boxes = Float64[np.ndarray, "_ 6"]

_CELL_M = 10.0
"""Bodies whose middles are farther apart do not meet parked cars."""
_MANY = 1 << 20


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
    cells = _numbered(np.floor(parked[:, :2] / _CELL_M).astype(np.int64))
    number = _numbered(np.floor(pose[:, :2] / _CELL_M).astype(np.int64))
    order = np.argsort(number, kind="stable")
    number = number[order]
    # Cells above each other have consecutive numbers: three runs hold all nine around one.
    columns = cells[:, None] + _MANY * np.array([-1, 0, 1])
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


def _numbered(cells: Int64[np.ndarray, "*shape 2"]) -> Int64[np.ndarray, "*shape"]:
    """Give every cell of the plane a number of its own."""
    return cells[..., 0] * _MANY + cells[..., 1]
