"""Several processes of one training run: which one this is, and what the others do.

``torchrun -m infgen train ...`` starts the same command several times. The first process
runs the command; the others know nothing of stages, locks or logs: they wait until the
first one trains, take part in that, and leave when it does. Light to import: without
``torchrun`` none of this costs anything.
"""

import atexit
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import NoReturn

from pipeline.stages.train.ranks import find_rank


def run(command: Callable[[], None], environ: Mapping[str, str]) -> None:
    """Run a command in the first process; any other takes part where it is called."""
    with joined(environ) as first:
        if first:
            command()


def leave(code: int, environ: Mapping[str, str]) -> NoReturn:
    """End this process with an exit code, after all that is due at an exit.

    Among several, without the interpreter's own end: a thread of gloo lets go of a tensor
    some time after its sum is known, and if the interpreter ends meanwhile, pybind aborts
    the process (signal 6, torch 2.13).
    """
    if find_rank(environ).count == 1:
        sys.exit(code)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code)


@contextmanager
def joined(environ: Mapping[str, str]) -> Iterator[bool]:
    """Find the rank of this process from the variables that ``torchrun`` sets.

    Yields:
        True for the first process, or the only one: it runs the command. Any other has
        by then taken part in all there was.
    """
    rank = find_rank(environ)
    if rank.count == 1:
        yield True
        return
    # Imported late: torch takes a second, which single processes need not wait for.
    from pipeline.stages.train import process_group  # noqa: PLC0415
    from pipeline.stages.train.stage import take_part  # noqa: PLC0415

    with process_group.joined_group():
        if rank.number:
            process_group.follow(take_part)
        yield rank.number == 0
