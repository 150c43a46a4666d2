"""A unit of work on a Dask worker: its progress, and what becomes of a failed device."""

import logging
import os
import time
from typing import Any

from pipeline.engine.stage import Progress
from pipeline.engine.units import Outcome, Task, device_failure, do
from pipeline.workers.gpus import DEVICE_SHARE

PROGRESS_EVERY_S = 2.0
DEVICE = "GPU"
"""Dask's resource: the part of a device that a worker has."""
PROGRESS_TOPIC, DEVICE_TOPIC = "infgen-progress", "infgen-device"
LAST_WORDS_S = 1.0
"""A worker that ends itself waits so long for its reason to be sent."""
DEVICE_LOST = 74
"""Exit code of a worker whose device failed (EX_IOERR)."""


def run_with_progress(worker: Any, task: Task, key: str, mark: str) -> Outcome:
    """Do a task on a worker, and send its progress to the driver now and then.

    If the device of this process fails, the process ends: its unit begins again in another
    one, and no other unit fails on a device that refuses all work.

    Args:
        worker: The Dask worker of this process; Dask is not typed.
        task: The task.
        key: Name of the attempt on the cluster.
        mark: Of the run, in the names of its topics.
    """
    DEVICE_SHARE.set(float(worker.state.total_resources.get(DEVICE, 1.0)))
    try:
        return do(task, _progress_sender(worker, key, mark))
    except RuntimeError as error:
        reason = device_failure(error)
        if not reason:
            raise
        _end_this_process(worker, key, mark, reason)
        raise


def _end_this_process(worker: Any, key: str, mark: str, reason: str) -> None:
    """Say why, and end at once: an orderly end would wait for the device."""
    worker.log_event(f"{DEVICE_TOPIC}-{mark}", {"key": key, "reason": reason})
    logging.getLogger(__name__).exception(
        "%s: this worker ends, as its device failed: %s", key, reason
    )
    time.sleep(LAST_WORDS_S)
    os._exit(DEVICE_LOST)


def _progress_sender(worker: Any, key: str, mark: str) -> Progress:
    told = time.monotonic()

    def tell(done: float | int, total: float | int, note: str = "") -> None:
        nonlocal told
        if time.monotonic() - told >= PROGRESS_EVERY_S:
            told = time.monotonic()
            about = {"key": key, "done": float(done), "total": float(total), "note": note}
            worker.log_event(f"{PROGRESS_TOPIC}-{mark}", about)

    return tell
