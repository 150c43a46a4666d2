"""Names of tracks and map features as the integers that a ``Scene`` has for ids."""

import re
from collections.abc import Iterable
from itertools import count

_INTEGER = re.compile(r"0|[1-9]\d{0,18}")


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
        if _INTEGER.fullmatch(name) and int(name) <= largest
    }
    taken = set(found.values())
    free = (number for number in count() if number not in taken)
    return {name: found[name] if name in found else next(free) for name in names}
