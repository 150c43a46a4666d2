"""Several processes of one training run: which one this is, and what the others do.

``torchrun -m infgen train ...`` starts the same command several times. The first process
does as it is told; the others know nothing of stages, locks or logs: they wait until the
first one trains, take part in that, and leave when it does. Light to import: without
``torchrun`` none of this costs anything.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rank:
    """The place of a process among those that train together.

    Attributes:
        number: 0 is the first, who alone plans, locks, writes and tells.
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


def run(command: Callable[[], None], environ: Mapping[str, str]) -> None:
    """Run a command in the first process; any other takes part where it is called."""
    with joined(environ) as first:
        if first:
            command()


@contextmanager
def joined(environ: Mapping[str, str]) -> Iterator[bool]:
    """Find this process's place among others, as ``torchrun`` tells it.

    Yields:
        True for the first process, or the only one: it does what it is told. Any other has
        by then taken part in all there was.
    """
    number, count, local = (
        int(environ.get(name, default))
        for name, default in (("RANK", "0"), ("WORLD_SIZE", "1"), ("LOCAL_RANK", "0"))
    )
    _STATE.rank = Rank(number, count, local)
    if count == 1:
        yield True
        return
    from pipeline.stages.train import process_group  # noqa: PLC0415

    with process_group.met():
        if number:
            process_group.follow()
        yield number == 0
