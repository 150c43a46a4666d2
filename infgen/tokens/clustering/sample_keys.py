"""Reproducible samples that do not depend on worker or order.

Every item has a key: a hash of its identity. A sample is the items
with the smallest keys, so samples of samples are samples of the whole.
"""

import hashlib

import numpy as np
from jaxtyping import Int, Int64, UInt64

_STEP = np.uint64(0x9E3779B97F4A7C15)


def name_key(name: str) -> int:
    """Hash a name to 64 bits."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")


def item_keys(name: str, *numbers: Int[np.ndarray, " item"]) -> UInt64[np.ndarray, " item"]:
    """Hash items that are told apart by a name and whole numbers."""
    keys = np.full(len(numbers[0]), name_key(name), dtype=np.uint64)
    for number in numbers:
        keys = _mix(keys ^ _mix(number.astype(np.uint64)))
    return keys


def smallest_keys(
    keys: UInt64[np.ndarray, " item"], count: int
) -> Int64[np.ndarray, " sample"]:
    """Return rows of the smallest keys, ascending; of equal keys the first row only."""
    rows = np.unique(keys, return_index=True)[1]
    return rows[:count]


def _mix(keys: np.ndarray) -> np.ndarray:
    """Scatter 64-bit numbers (the finaliser of splitmix64, Steele et al. 2014)."""
    keys = keys + _STEP
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return keys ^ (keys >> np.uint64(31))
