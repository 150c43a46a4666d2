"""Names of tracks and map features as the integers that a ``Scene`` has for ids."""

import re
from collections.abc import Iterable
from itertools import count

_INTEGER = re.compile(r"0|-?[1-9][0-9]{0,18}")


def integer_name(name: object) -> int | None:
    """Return the integer that a name stands for by itself; None if it is none."""
    if type(name) is int:
        return name if -(2**63) <= name < 2**63 else None
    if not isinstance(name, str) or not _INTEGER.fullmatch(name):
        return None
    return int(name) if -(2**63) <= int(name) < 2**63 else None


def integer_ids(names: Iterable[str], largest: int) -> dict[str, int]:
    """Give each name an integer: its own if it is one, else the next that is free.

    Example: ``["138902", "AV", "x7"]`` becomes 138902, 0 and 1.

    Args:
        names: All different.
        largest: Largest integer that may stand for a name.
    """
    names = list(names)
    found = {
        name: int(name)
        for name in names
        if _INTEGER.fullmatch(name) and -largest - 1 <= int(name) <= largest
    }
    taken = set(found.values())
    free = (number for number in count() if number not in taken)
    return {name: found[name] if name in found else next(free) for name in names}
