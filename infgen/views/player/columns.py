"""Whole numbers as a small piece of text, and back.

Every column becomes bytes with the low bytes of all values first, then the next ones: in
differences of slow motion all but the first are nearly always zero, and deflate all but
forgets them. The whole is written in base64, so that it may stand in a page.
"""

import base64
import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

_LENGTH = struct.Struct("<I")
_LEVEL = 6
"""Level 9 takes twenty times as long for 4 % less."""


class PayloadError(ValueError):
    """Text that is not what ``pack_columns`` writes."""


def pack_columns(about: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> str:
    """Write columns of whole numbers, and some words about them, as text.

    Args:
        about: Anything that JSON can hold.
        columns: One-dimensional arrays of int8, int16 or int32, by name.
    """
    table = [[name, values.dtype.name, len(values)] for name, values in columns.items()]
    header = json.dumps({"about": about, "columns": table}).encode()
    parts = [_LENGTH.pack(len(header)), header]
    parts += [_byte_planes(values) for values in columns.values()]
    return base64.b64encode(zlib.compress(b"".join(parts), _LEVEL)).decode()


def unpack_columns(text: str) -> tuple[Mapping[str, Any], dict[str, np.ndarray]]:
    """Read what ``pack_columns`` wrote.

    Raises:
        PayloadError: if it did not.
    """
    try:
        data = zlib.decompress(base64.b64decode(text, validate=True))
        (length,) = _LENGTH.unpack_from(data)
        at = _LENGTH.size + length
        header = json.loads(data[_LENGTH.size : at])
    except (ValueError, zlib.error, struct.error) as error:
        raise PayloadError(f"no payload: {error}") from error
    columns = {}
    for name, agent_type, count in header["columns"]:
        size = np.dtype(agent_type).itemsize * count
        planes = np.frombuffer(data[at : at + size], np.uint8)
        if len(planes) < size:
            raise PayloadError(f"column {name} is cut short")
        values = np.ascontiguousarray(planes.reshape(-1, count or 1).T).reshape(-1)
        columns[name] = values.view(np.dtype(agent_type).newbyteorder("<")).astype(
            agent_type
        )
        at += size
    return header["about"], columns


def _byte_planes(values: np.ndarray) -> bytes:
    little = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<")))
    return little.view(np.uint8).reshape(len(values), values.itemsize).T.tobytes()
