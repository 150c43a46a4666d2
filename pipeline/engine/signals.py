"""Stopping on SIGTERM and SIGINT without leaving anything half done.

The first signal raises ``Stopped`` at once, except inside ``whole()`` (a write that must
be finished; it is raised at its end) and inside ``deferred()`` (work that saves its state;
it is raised by the next ``check()``). A second signal raises at once inside ``deferred()``
too.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Stopped(BaseException):
    """The process was asked to stop. Not an ``Exception``: nothing shall swallow it.

    Attributes:
        signal: Number of the signal; the exit code is 128 more.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.signal = number


@dataclass
class _State:
    """Signals belong to the process, and so does this."""

    pending: int = 0
    whole: int = 0
    deferred: int = 0


_STATE = _State()


@contextmanager
def handling_signals() -> Iterator[None]:
    """Turn SIGTERM and SIGINT into ``Stopped`` for the length of the block."""
    before = {number: signal.signal(number, _note) for number in SIGNALS}
    _STATE.pending = 0
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if not (_STATE.whole or _STATE.deferred):
            _STATE.pending = 0  # Who comes after is not asked to stop.


@contextmanager
def whole() -> Iterator[None]:
    """Put a signal off until the block is done."""
    _STATE.whole += 1
    try:
        yield
    finally:
        _STATE.whole -= 1
    if _STATE.pending and not _STATE.whole and not _STATE.deferred:
        raise Stopped(_STATE.pending)


@contextmanager
def deferred() -> Iterator[None]:
    """Leave it to the block to call ``check`` where it can stop well."""
    _STATE.deferred += 1
    try:
        yield
    finally:
        _STATE.deferred -= 1
    check()


def asked() -> int:
    """Return the number of the signal that has come; 0 if none has."""
    return _STATE.pending


def check() -> None:
    """Stop here if a signal has come.

    Raises:
        Stopped: if so.
    """
    if _STATE.pending and not _STATE.whole:
        raise Stopped(_STATE.pending)


def _note(number: int, frame: FrameType | None) -> None:
    again = bool(_STATE.pending)
    _STATE.pending = number
    if not _STATE.whole and (again or not _STATE.deferred):
        raise Stopped(number)
