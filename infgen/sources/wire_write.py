"""The protobuf wire format, written: the counterpart of ``wire``."""

import struct
from functools import cache

from infgen.sources.wire import BYTES, FIXED64, VARINT, tag


@cache
def key(number: int, wire_type: int) -> bytes:
    """Write the tag of a field."""
    return varint(tag(number, wire_type))


def varint(value: int) -> bytes:
    """Write seven bits a byte, lowest first; negative numbers as 64 bits."""
    value &= (1 << 64) - 1
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def integer(number: int, value: int) -> bytes:
    """Write a field that holds a whole number, a truth value or an enum."""
    return key(number, VARINT) + varint(value)


def double(number: int, value: float) -> bytes:
    """Write a field that holds a double."""
    return key(number, FIXED64) + struct.pack("<d", value)


def message(number: int, body: bytes) -> bytes:
    """Write a field that holds a message, a text or packed values."""
    return key(number, BYTES) + varint(len(body)) + body


def text(number: int, words: str) -> bytes:
    """Write a field that holds a text."""
    return message(number, words.encode())
