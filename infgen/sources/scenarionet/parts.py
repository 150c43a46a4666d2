"""Parts of a description: taken by name, and of the type they must have."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from infgen.sources.scenarionet.pickles import Array, array
from infgen.sources.tfrecord import RecordError

Part = Mapping[str, Any]


def part_of(owner: Part, name: str, where: str) -> Part:
    """Return a part that is a dictionary.

    Raises:
        RecordError: naming it, if it is missing or anything else.
    """
    found = owner.get(name)
    if not isinstance(found, dict):
        raise RecordError(f"{where} has no dictionary {name!r}")
    return found


def named_parts(owner: Part, name: str, where: str) -> dict[str, Part]:
    """Return a dictionary of dictionaries, its keys as text.

    Raises:
        RecordError: if it is missing or holds anything else, or a key twice.
    """
    found: dict[str, Part] = {}
    for key, value in part_of(owner, name, where).items():
        if not isinstance(value, dict):
            raise RecordError(f"{name} {str(key)[:40]!r} is no dictionary")
        if str(key) in found:
            raise RecordError(f"{name} holds {str(key)[:40]!r} twice")
        found[str(key)] = value
    return found


def points_of(value: Any, where: str) -> Float64[np.ndarray, "point n"]:
    """Return points of two or more coordinates; none of a missing or empty list.

    Raises:
        RecordError: if it is neither.
    """
    if value is None:
        return np.empty((0, 2))
    found = array(value)
    if found.ndim == 1 and len(found) in (2, 3):
        found = found[None]
    if found.size == 0:
        return np.empty((0, 2))
    if found.ndim != 2 or found.shape[1] < 2:
        raise RecordError(f"{where} has points of shape {found.shape}")
    return found


def sequence_of(value: Any) -> Sequence[Any]:
    """Return a list, tuple or array of plain values as a sequence; empty if missing."""
    if isinstance(value, Array):
        return value.read().tolist()
    return value if isinstance(value, list | tuple) else ()


def text_of(value: Any) -> str:
    """Return a text; empty if it is none."""
    return value if isinstance(value, str) else ""


def integer_of(value: Any, default: int = 0) -> int:
    """Return a whole number, also one written as text; the default if it is none."""
    if isinstance(value, str):
        value = (
            int(value) if value.isascii() and value.isdigit() and len(value) < 19 else None
        )
    return value if type(value) is int else default


def number_of(value: Any) -> float:
    """Return a finite number; 0 if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return 0.0
    try:
        found = float(value)
    except (ValueError, OverflowError):
        return 0.0
    return found if np.isfinite(found) else 0.0
