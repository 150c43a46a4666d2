"""The protobuf wire format: a generic walk over one message.

A message is fields end to end; a field is a varint tag (number x 8 + wire type) and a
value: a varint, 4 or 8 bytes, or a length and so many bytes. Fields come in any order,
unknown ones are passed over, and of a single value given twice the last counts.
"""

import struct
from array import array
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

VARINT, FIXED64, BYTES, GROUP, GROUP_END, FIXED32 = range(6)

_MAX_VARINT_BYTES = 10
_MAX_TAG = 1 << 32
_MAX_DEPTH = 100
_MAX_RUN = 512

MAX_MESSAGES = 16_000_000
"""Points or states of one record. The largest real one has about 100,000, five minutes of a
crowded town have five million."""
MAX_FIELDS = 500_000
"""Other fields of one message, or values of a repeated one. Real ones have thousands."""


class WireError(ValueError):
    """Bytes that are no protobuf message."""


class Field(NamedTuple):
    """One field of a message.

    Attributes:
        tag: Number x 8 + wire type.
        value: Of a varint; else 0.
        start: First byte of the value (after its length, if it has one).
        end: One past its last byte.
    """

    tag: int
    value: int
    start: int
    end: int


# The constructor of a NamedTuple takes three times as long.
_new_field = partial(tuple.__new__, Field)


class Spans:
    """Where the messages of one repeated field lie, as runs of equally long neighbours.

    Attributes:
        total: Messages in all runs.
    """

    __slots__ = ("_runs", "total")

    def __init__(self) -> None:
        self._runs = array("q")
        self.total = 0

    def add(self, first: int, size: int, count: int = 1) -> None:
        """Append so many messages of ``size`` bytes, two header bytes before each.

        Raises:
            WireError: if there are more than any real record holds.
        """
        self._runs.extend((first, size, count))
        self.total += count
        if self.total > MAX_MESSAGES:
            raise WireError(f"record holds more than {MAX_MESSAGES} points or states")

    def runs(self) -> Int64[np.ndarray, "run 3"]:
        """Start of the first message, size of each and number of messages of all runs."""
        return np.frombuffer(self._runs, np.int64).reshape(-1, 3)


def tag(number: int, wire_type: int) -> int:
    """Return the tag of a field."""
    return number << 3 | wire_type


def read_varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    """Read an unsigned varint; return it (64 bits kept) and the position after it.

    Raises:
        WireError: if it is longer than ten bytes or than what is left.
    """
    left = end - at
    if left > 0 and (low := data[at]) < 0x80:
        return low, at + 1
    if left > 1 and (high := data[at + 1]) < 0x80:
        return low & 0x7F | high << 7, at + 2
    value = shift = 0
    for stop in range(at, min(end, at + _MAX_VARINT_BYTES)):
        byte = data[stop]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, stop + 1
        shift += 7
    raise WireError(f"varint at byte {at} does not end")


def read_field(data: bytes, at: int, end: int) -> Field:
    """Read the field that starts at a byte.

    Raises:
        WireError: if there is no sound field.
    """
    key, start = read_varint(data, at, end)
    if not 8 <= key < _MAX_TAG:
        raise WireError(f"field at byte {at} has number {key >> 3}")
    kind = key & 7
    value = 0
    if kind == VARINT:
        value, stop = read_varint(data, start, end)
    elif kind == BYTES:
        size, start = read_varint(data, start, end)
        stop = start + size
    elif kind == FIXED64:
        stop = start + 8
    elif kind == FIXED32:
        stop = start + 4
    elif kind == GROUP:
        stop = _group_end(data, start, end, key >> 3)
    else:
        raise WireError(f"field at byte {at} has wire type {kind}")
    if stop > end:
        raise WireError(f"field {key >> 3} at byte {at} runs past its message")
    return _new_field((key, value, start, stop))


def walk(data: bytes, start: int, end: int) -> list[Field]:
    """List the fields of the message in ``data[start:end]``.

    Raises:
        WireError: where they stop being sound.
    """
    return split(data, start, end, 0, Spans())


def split(data: bytes, start: int, end: int, repeated: int, spans: Spans) -> list[Field]:
    """Walk a message that is mostly one repeated field: a line of points, say.

    Args:
        data: The record.
        start: First byte of the message.
        end: One past its last byte.
        repeated: Tag of the repeated field; below 128 and of type ``BYTES``.
        spans: Gets the messages of the repeated field.

    Returns:
        All other fields.

    Raises:
        WireError: if the message is not sound, or holds more than any real one.
    """
    others: list[Field] = []
    at = start
    try:
        while at < end and len(others) < MAX_FIELDS:
            key, low = data[at], data[at + 1]
            # One-byte tags with one-byte values or lengths are read in place.
            kind = key & 7 if 7 < key < 0x80 and low < 0x80 else GROUP
            if kind == VARINT:
                others.append(_new_field((key, low, at + 1, at + 2)))
                at += 2
            elif kind != BYTES:
                field = read_field(data, at, end)
                at = field.end
                if field.tag == repeated:
                    spans.add(field.start, field.end - field.start)
                else:
                    others.append(field)
            elif key == repeated:
                at = _pass_run(data, at, end, low, spans)
            else:
                others.append(_new_field((key, 0, at + 2, at + 2 + low)))
                at += 2 + low
    except IndexError:
        at = end + 1
    if at < end:
        raise WireError(f"message at byte {start} holds more than {MAX_FIELDS} fields")
    if at > end:
        raise WireError(f"message at byte {start} runs past its end")
    return others


def _pass_run(data: bytes, at: int, end: int, size: int, spans: Spans) -> int:
    """Note the message at a byte and those like it that follow; return where they end."""
    stride = size + 2
    stop = min(end, at + _MAX_RUN * stride)
    tags, sizes = data[at:stop:stride], data[at + 1 : stop : stride]
    alike = len(tags) - len(tags.lstrip(tags[:1]))
    count = min(alike, len(sizes) - len(sizes.lstrip(sizes[:1])))
    spans.add(at + 2, size, count)
    return at + count * stride


def last(fields: Sequence[Field], key: int, default: int = 0) -> int:
    """Return the value of a varint field: the last one given counts."""
    for field in reversed(fields):
        if field.tag == key:
            return field.value
    return default


def last_enum(fields: Sequence[Field], key: int, largest: int) -> int:
    """Return the last known value of an enum field; unknown ones do not count."""
    for field in reversed(fields):
        if field.tag == key and field.value <= largest:
            return field.value
    return 0


def signed(value: int, bits: int = 64) -> int:
    """Read the low bits of a varint as a signed number, as protobuf's intN does."""
    low = value & ((1 << bits) - 1)
    return low - (1 << bits) if low >> (bits - 1) else low


def varints(data: bytes, fields: Sequence[Field], number: int) -> list[int]:
    """Values of a repeated varint field, packed or not, as signed 64-bit numbers.

    Raises:
        WireError: if a packed value is cut short.
    """
    single, packed = tag(number, VARINT), tag(number, BYTES)
    values = []
    for field in fields:
        if field.tag == single:
            values.append(signed(field.value))
        elif field.tag == packed:
            at = field.start
            while at < field.end:
                value, at = read_varint(data, at, field.end)
                values.append(signed(value))
                if len(values) > MAX_FIELDS:
                    raise WireError(f"field {number} has more than {MAX_FIELDS} values")
    return values


def doubles(data: bytes, fields: Sequence[Field], number: int) -> list[float]:
    """Values of a repeated double field, packed or not.

    Raises:
        WireError: if packed values are not a whole number of doubles.
    """
    values: list[float] = []
    for field in fields:
        if field.tag in (tag(number, FIXED64), tag(number, BYTES)):
            count, rest = divmod(field.end - field.start, 8)
            if rest:
                raise WireError(f"packed field {number} is not a whole number of doubles")
            values += struct.unpack_from(f"<{count}d", data, field.start)
    return values


def _group_end(data: bytes, start: int, end: int, number: int) -> int:
    """Pass over a group (an old kind of sub-message); return the position after it."""
    open_groups = [number]
    while open_groups:
        key, at = read_varint(data, start, end)
        if key & 7 == GROUP:
            open_groups.append(key >> 3)
        if key & 7 == GROUP_END:
            if open_groups.pop() != key >> 3:
                raise WireError(f"group end at byte {start} does not match its start")
        elif key & 7 != GROUP:
            at = read_field(data, start, end).end
        if len(open_groups) > _MAX_DEPTH:
            raise WireError(f"groups at byte {start} are nested too deep")
        start = at
    return start
