"""Decode many small protobuf messages of one type at once.

Messages of one type and length nearly always have one layout: the same fields in the same
order at the same bytes. It is learned from the first message of a length and then *verified
on every byte that makes it a layout* (tags, lengths, continuation bits of varints) for all
others; messages that differ are tried against a layout of their own. Real files differ in
the order of fields and in how they write invalid states, so no layout is built in.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64, UInt8

from infgen.sources import wire
from infgen.sources.wire import BYTES, FIXED32, FIXED64, VARINT, Field, Spans, WireError

_MAX_LAYOUTS = 32
_LAYOUT_BITS = {VARINT: 0x80, FIXED32: 0, FIXED64: 0, BYTES: 0}
"""Bits of a value's bytes, by wire type, that decide where the next field starts."""

_TYPES: dict[int, np.dtype[Any]] = {
    FIXED64: np.dtype("<f8"),
    FIXED32: np.dtype("<f4"),
    VARINT: np.dtype("<u8"),
}


@dataclass(frozen=True, slots=True)
class Messages:
    """Where messages lie in a record, in order.

    Attributes:
        start: First byte of each.
        size: Bytes of each.
    """

    start: Int64[np.ndarray, " message"]
    size: Int64[np.ndarray, " message"]

    def __len__(self) -> int:
        return len(self.start)


def messages(spans: Spans) -> Messages:
    """Spell out runs of messages."""
    first, size, count = spans.runs().T
    within = np.arange(spans.total) - np.repeat(np.cumsum(count) - count, count)
    start = np.repeat(first, count) + np.repeat(size + 2, count) * within
    return Messages(start, np.repeat(size, count))


def decode(
    data: bytes, rows: Messages, columns: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Decode messages into one array per field; absent fields are zero.

    Args:
        data: The record.
        rows: The messages.
        columns: Name to tag of each wanted field. Doubles and floats become float64 and
            float32, varints uint64. A sub-message becomes the position of its first byte
            (int64, -1 if absent) under its name, its size under ``name + ".size"``.

    Returns:
        The arrays, one element per message.

    Raises:
        WireError: if a message is not sound, or holds a wanted sub-message twice.
    """
    out = _empty(len(rows), columns)
    buffer = np.frombuffer(data, np.uint8)
    order = np.argsort(rows.size, kind="stable")
    edges = np.flatnonzero(np.diff(rows.size[order], prepend=-1, append=-1))
    layouts = 0
    for begin, end in pairwise(edges.tolist()):
        left = order[begin:end]
        size = int(rows.size[left[0]])
        while len(left) and layouts < _MAX_LAYOUTS:
            layouts += 1
            left = _decode_alike(data, buffer, rows.start, left, size, columns, out)
        for row in left.tolist():
            _decode_one(data, int(rows.start[row]), size, row, columns, out)
    return out


def _empty(length: int, columns: Mapping[str, int]) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    for name, key in columns.items():
        if key & 7 == BYTES:
            out[name] = np.full(length, -1, np.int64)
            out[f"{name}.size"] = np.zeros(length, np.int64)
        else:
            out[name] = np.zeros(length, _TYPES[key & 7])
    return out


def _decode_alike(
    data: bytes,
    buffer: UInt8[np.ndarray, " byte"],
    starts: Int64[np.ndarray, " message"],
    rows: Int64[np.ndarray, " row"],
    size: int,
    columns: Mapping[str, int],
    out: dict[str, np.ndarray],
) -> Int64[np.ndarray, " left"]:
    """Decode all rows (of one size) that are laid out like the first; return the others."""
    at = int(starts[rows[0]])
    fields = _fields(data, at, size, columns)
    windows = np.lib.stride_tricks.sliding_window_view(buffer, size)
    bodies = windows[starts[rows]]  # [row, size]
    alike = _same_layout(bodies, fields, at)
    if not alike.all():
        bodies, left, rows = bodies[alike], rows[~alike], rows[alike]
    else:
        left = rows[:0]
    for name, key in columns.items():
        for field in fields:
            if field.tag != key:
                continue
            if key & 7 == BYTES:
                out[name][rows] = starts[rows] + (field.start - at)
                out[f"{name}.size"][rows] = field.end - field.start
            else:
                out[name][rows] = _values(bodies, key & 7, field.start - at, field.end - at)
    return left


def _fields(data: bytes, at: int, size: int, columns: Mapping[str, int]) -> list[Field]:
    fields = wire.walk(data, at, at + size)
    for name, key in columns.items():
        if key & 7 == BYTES and sum(field.tag == key for field in fields) > 1:
            raise WireError(f"message at byte {at} holds {name} twice")
    return fields


def _same_layout(
    bodies: UInt8[np.ndarray, "row size"], fields: list[Field], at: int
) -> Bool[np.ndarray, " row"]:
    """Compare with the first row every bit that decides where values lie."""
    mask = np.full(bodies.shape[1], 0xFF, np.uint8)
    for field in fields:
        mask[field.start - at : field.end - at] = _LAYOUT_BITS.get(field.tag & 7, 0xFF)
    decides = np.flatnonzero(mask)
    differ = (bodies[:, decides] ^ bodies[0, decides]) & mask[decides]
    return ~differ.any(axis=1)


def _values(
    bodies: UInt8[np.ndarray, "row size"], wire_type: int, begin: int, end: int
) -> np.ndarray:
    part = bodies[:, begin:end]
    if wire_type != VARINT:
        return np.ascontiguousarray(part).view(_TYPES[wire_type])[:, 0]
    value = np.zeros(len(bodies), np.uint64)
    for shift in range(end - begin):
        value |= (part[:, shift] & 0x7F).astype(np.uint64) << np.uint64(7 * shift)
    return value


def _decode_one(
    data: bytes,
    at: int,
    size: int,
    row: int,
    columns: Mapping[str, int],
    out: dict[str, np.ndarray],
) -> None:
    """Decode one message whose layout is rare."""
    for field in _fields(data, at, size, columns):
        for name, key in columns.items():
            if field.tag != key:
                continue
            if key & 7 == BYTES:
                out[name][row] = field.start
                out[f"{name}.size"][row] = field.end - field.start
            elif key & 7 == VARINT:
                out[name][row] = field.value
            else:
                raw = data[field.start : field.end]
                out[name][row] = np.frombuffer(raw, _TYPES[key & 7])[0]
