"""Records made of tensors, changed tensor by tensor."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar

from torch import Tensor

T = TypeVar("T")


def map_tensors(record: T, change: Callable[[Tensor], Tensor]) -> T:
    """Change every tensor of a dataclass, of those within it, and of lists of them."""
    if isinstance(record, Tensor):
        return change(record)  # type: ignore[return-value]
    if isinstance(record, list):
        return [map_tensors(part, change) for part in record]  # type: ignore[return-value]
    if not is_dataclass(record):
        return record
    parts = {f.name: map_tensors(getattr(record, f.name), change) for f in fields(record)}
    return replace(record, **parts)  # type: ignore[type-var]


def in_float32(record: T) -> T:
    """Bring every tensor of fewer bits to float32."""
    return map_tensors(record, lambda x: x.float() if x.is_floating_point() else x)
