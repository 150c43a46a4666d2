"""Stopping on SIGTERM and SIGINT without leaving anything half done.

The first signal raises ``Stopped`` at once, except

- inside ``uninterrupted()`` (a write that must be finished), where it is raised at the end;
- inside ``deferred()`` (work that saves its state), where the next ``raise_if_stopped()``
  raises it. A second signal raises at once there.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Stopped(BaseException):
    """The process was asked to stop. No ``Exception``, so that no handler swallows it.

    Attributes:
        signal: Number of the signal; the exit code is 128 more.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.signal = number


@dataclass
class _State:
    """State of the process: signals arrive once for all of it."""

    pending: int = 0
    uninterrupted: int = 0
    deferred: int = 0


_STATE = _State()


@contextmanager
def handling_signals() -> Iterator[None]:
    """Turn SIGTERM and SIGINT into ``Stopped`` during the block."""
    before = {number: signal.signal(number, _on_signal) for number in SIGNALS}
    _STATE.pending = 0
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if not (_STATE.uninterrupted or _STATE.deferred):
            _STATE.pending = 0  # The signal was not for later blocks.


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay signals until the end of the block."""
    _STATE.uninterrupted += 1
    try:
        yield
    finally:
        _STATE.uninterrupted -= 1
    if _STATE.pending and not _STATE.uninterrupted and not _STATE.deferred:
        raise Stopped(_STATE.pending)


@contextmanager
def deferred() -> Iterator[None]:
    """Delay a signal until the block calls ``raise_if_stopped``."""
    _STATE.deferred += 1
    try:
        yield
    finally:
        _STATE.deferred -= 1
    raise_if_stopped()


def pending_signal() -> int:
    """Return the number of the signal that has arrived; 0 if none has."""
    return _STATE.pending


def raise_if_stopped() -> None:
    """Raise ``Stopped`` if a signal has arrived.

    Raises:
        Stopped: if so.
    """
    if _STATE.pending and not _STATE.uninterrupted:
        raise Stopped(_STATE.pending)


def _on_signal(number: int, frame: FrameType | None) -> None:
    second = bool(_STATE.pending)
    _STATE.pending = number
    if not _STATE.uninterrupted and (second or not _STATE.deferred):
        raise Stopped(number)
