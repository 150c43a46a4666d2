"""Arrays of scenes of different sizes, side by side."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch

from infgen.tokens.scene_tokens import NO_CELL, NO_MOTION_TOKEN

T = TypeVar("T")
Arrays = dict[str, np.ndarray]
"""Arrays of one scene, by the names of the fields they become."""

NO_AGENT = -1
"""Agent of an empty slot."""

_PADDING = {
    "motion_token": NO_MOTION_TOKEN,
    "label": NO_MOTION_TOKEN,
    "cell": NO_CELL,
    "turn": -1,
    "agent": NO_AGENT,
}


def pad(scenes: Sequence[Arrays], kind: type[T]) -> T:
    """Stack arrays of different sizes, filled up at their ends."""
    tensors = {}
    for name in scenes[0]:
        parts = [scene[name] for scene in scenes]
        shape = np.max([part.shape for part in parts], axis=0)
        dtype = parts[0].dtype if parts[0].dtype.kind in "fb" else np.dtype(np.int64)
        fill = _PADDING.get(name, 0)
        padded = np.full((len(parts), *shape), fill, dtype=dtype)
        for row, part in enumerate(parts):
            padded[row][tuple(slice(size) for size in part.shape)] = part
        tensors[name] = torch.from_numpy(padded)
    return kind(**tensors)
