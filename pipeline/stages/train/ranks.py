"""The rank of this process among those that train together."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rank:
    """The place of a process among those that train together.

    Attributes:
        number: 0 is the first; it alone plans, locks, writes and reports.
        count: How many there are.
        local: Number of this one on its machine, and of its GPU.
    """

    number: int = 0
    count: int = 1
    local: int = 0


@dataclass
class _State:
    """A process has one place."""

    rank: Rank = Rank()


_STATE = _State()


def own_rank() -> Rank:
    """Return the place of this process."""
    return _STATE.rank


def find_rank(environ: Mapping[str, str]) -> Rank:
    """Read this process's rank from the variables that ``torchrun`` sets, and keep it."""
    number, count, local = (
        int(environ.get(name, default))
        for name, default in (("RANK", "0"), ("WORLD_SIZE", "1"), ("LOCAL_RANK", "0"))
    )
    _STATE.rank = Rank(number, count, local)
    return _STATE.rank
