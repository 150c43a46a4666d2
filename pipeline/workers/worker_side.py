"""A unit of work on a Dask worker: its progress, its time limit, a failed device."""

import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from typing import Any

from pipeline.engine.stage import Progress
from pipeline.engine.units import Outcome, Task, device_failure, do
from pipeline.workers.gpus import DEVICE_SHARE

PROGRESS_EVERY_S = 2.0
DEVICE = "GPU"
"""Dask's resource: the part of a device that a worker has."""
PROGRESS_TOPIC, DEVICE_TOPIC = "infgen-progress", "infgen-device"
TIMEOUT_TOPIC = "infgen-timeout"
LAST_WORDS_S = 1.0
"""A worker that ends itself waits so long for its reason to be sent."""
DEVICE_LOST, TIMED_OUT = 74, 75
"""Exit codes of a worker whose device failed (EX_IOERR), and whose unit took too long
(EX_TEMPFAIL)."""


def run_with_progress(
    worker: Any, task: Task, key: str, mark: str, limit_s: float
) -> Outcome:
    """Do a task on a worker, and send its progress to the driver now and then.

    If the device of this process fails, the process ends: its unit begins again in another
    one, and no other unit fails on a device that refuses all work. If the unit takes too
    long, the process ends too: what hangs (a lost disk, say) cannot be ended otherwise.

    Args:
        worker: The Dask worker of this process; Dask is not typed.
        task: The task.
        key: Name of the attempt on the cluster.
        mark: Of the run, in the names of its topics.
        limit_s: Longest time that the unit may take; 0 for any.
    """
    DEVICE_SHARE.set(float(worker.state.total_resources.get(DEVICE, 1.0)))
    try:
        with _time_limit(worker, key, mark, limit_s):
            return do(task, _progress_sender(worker, key, mark))
    except RuntimeError as error:
        reason = device_failure(error)
        if not reason:
            raise
        worker.log_event(f"{DEVICE_TOPIC}-{mark}", {"key": key, "reason": reason})
        _end_this_process(key, f"its device failed: {reason}", DEVICE_LOST)
        raise


@contextmanager
def _time_limit(worker: Any, key: str, mark: str, limit_s: float) -> Iterator[None]:
    """End this process if the block takes longer than that."""

    def end() -> None:
        worker.log_event(f"{TIMEOUT_TOPIC}-{mark}", {"key": key, "limit_s": limit_s})
        _end_this_process(key, f"the unit took longer than {limit_s:g} s", TIMED_OUT)

    if not limit_s:
        yield
        return
    timer = Timer(limit_s, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _end_this_process(key: str, reason: str, code: int) -> None:
    """Say why, and end at once: an orderly end would wait for the unit or the device."""
    logging.getLogger(__name__).error("%s: this worker ends, as %s", key, reason)
    time.sleep(LAST_WORDS_S)
    os._exit(code)


def _progress_sender(worker: Any, key: str, mark: str) -> Progress:
    told = time.monotonic()

    def tell(done: float | int, total: float | int, note: str = "") -> None:
        nonlocal told
        if time.monotonic() - told >= PROGRESS_EVERY_S:
            told = time.monotonic()
            about = {"key": key, "done": float(done), "total": float(total), "note": note}
            worker.log_event(f"{PROGRESS_TOPIC}-{mark}", about)

    return tell
