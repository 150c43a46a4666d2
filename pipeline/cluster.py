"""Units of work on Dask workers: on this machine, on its GPUs, or on any cluster.

Workers write their results themselves and send back a few figures. At most two tasks per
worker thread are on their way at once, so that the scheduler never holds many.
"""

import logging
import os
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any

from infgen.config import ConfigError
from pipeline.stage import Progress
from pipeline.work import Executor, InProcess, Outcome, Task, do, failure

HELP = "none | local[:N] | gpu[:0,1] | tcp://HOST:PORT | file:scheduler.json"
LOOPBACK = "127.0.0.1"  # Dask runs what anyone who connects sends it.
RETRIES = 2
RESUBMISSIONS = 1
TASKS_PER_THREAD = 2
LOST_WORKER = {"distributed.deploy.lost-worker-timeout": "1 day"}
"""A worker that is just being restarted when this time is up is given up for good; with the
usual 15 seconds a few crashes leave a cluster without workers, and a run that never ends.
"""
WORKER_ENVIRONMENT = {"ZARR_ASYNC__CONCURRENCY": "4", "ZARR_THREADING__MAX_WORKERS": "2"}


class Workers:
    """Whoever does the units. A cluster starts only when the first unit needs it."""

    def __init__(self, words: str) -> None:
        self._words = words
        self._stack = ExitStack()
        self._executor: Executor | None = InProcess() if words == "none" else None
        if words != "none":
            parse(words)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def executor(self, *, here: bool) -> Executor:
        """Return who does the units of a stage; ``here`` if it must be this process."""
        if here:
            return InProcess()
        if self._executor is None:
            client = self._stack.enter_context(_client(self._words))
            self._executor = OnDask(client)
        return self._executor


def parse(words: str) -> tuple[str, str]:
    """Split ``local:4`` into kind and rest.

    Raises:
        ConfigError: for words that name no kind of workers.
    """
    if not re.fullmatch(r"local(:[1-9]\d*)?|gpu(:\d+(,\d+)*)?|(tcp|tls|file):.+", words):
        raise ConfigError(f"--dask {words}: expected {HELP}")
    kind, _, rest = words.partition(":")
    return kind, rest


@contextmanager
def _client(words: str) -> Iterator[Any]:
    kind, rest = parse(words)
    place = {"scheduler_file": rest} if kind == "file" else {"address": words}
    with ExitStack() as stack:
        _dask()  # First: it adds to the settings that are put back in the end.
        stack.enter_context(import_module("dask").config.set(LOST_WORKER))
        if kind == "local":
            cluster = _local(int(rest or os.cpu_count() or 1))
            place = {"address": stack.enter_context(cluster)}
        elif kind == "gpu":
            cluster = _gpus(rest.split(",") if rest else _all_gpus())
            place = {"address": stack.enter_context(cluster)}
        client = stack.enter_context(_dask().Client(**place, set_as_default=False))
        client.get_versions(check=True)
        yield client


def _dask() -> Any:
    """Import Dask late, and once: it takes more than a second and is not typed."""
    return import_module("distributed")


def _local(count: int) -> Any:
    return _dask().LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        host=LOOPBACK,
        dashboard_address=None,
        silence_logs=logging.ERROR,
        env=WORKER_ENVIRONMENT,
    )


def _gpus(devices: Sequence[str]) -> Any:
    """One worker process per device, which sees that device alone before any import."""
    workers = {
        device: {
            "cls": _dask().Nanny,
            "options": {
                "host": LOOPBACK,
                "nthreads": 1,
                "resources": {"GPU": 1},
                "env": {**WORKER_ENVIRONMENT, "CUDA_VISIBLE_DEVICES": device},
            },
        }
        for device in devices
    }
    options = {"host": LOOPBACK, "dashboard": False}
    scheduler = {"cls": _dask().Scheduler, "options": options}
    return _dask().SpecCluster(workers=workers, scheduler=scheduler)


def _all_gpus() -> list[str]:
    import torch  # noqa: PLC0415

    count = torch.cuda.device_count()
    if not count:
        raise ConfigError("--dask gpu: this machine has no CUDA device; try --dask local")
    return [str(device) for device in range(count)]


class OnDask:
    """Does tasks on the workers of a Dask client."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def run(
        self, tasks: Sequence[Task], go_on: Callable[[], bool], progress: Progress
    ) -> Iterator[Outcome]:
        """Do all tasks; begin no more once ``go_on()`` is False."""
        killed = _dask().KilledWorker
        waiting = [(task, 0) for task in reversed(tasks)]
        window = max(1, sum(self._client.nthreads().values())) * TASKS_PER_THREAD
        under_way: dict[Any, tuple[Task, int]] = {}
        finished = _dask().as_completed(loop=self._client.loop)

        def more() -> bool:
            return bool(waiting) and go_on() and self._client.status == "running"

        while more() or under_way:
            while more() and len(under_way) < window:
                task, tries = waiting.pop()
                future = self._submit(task, tries)
                under_way[future] = (task, tries)
                finished.add(future)
            future = next(finished)
            task, tries = under_way.pop(future)
            if future.status == "finished":
                yield future.result()
            elif isinstance(future.exception(), killed) and tries < RESUBMISSIONS:
                waiting.append((task, tries + 1))
            else:
                yield _failed(task, future)

    def _submit(self, task: Task, tries: int) -> Any:
        name = f"{task.about['stage']}-{task.target.name}-{tries}"
        return self._client.submit(do, task, _silent, key=name, retries=RETRIES, pure=False)


def _failed(task: Task, future: Any) -> Outcome:
    error = future.exception()
    if error is None:
        error = RuntimeError(f"{future.status}: the scheduler, or its connection, is lost")
    trace = "".join(traceback.format_tb(future.traceback()))
    return failure(task.unit.name, error, trace, 0.0)


def _silent(done: float | int, total: float | int, note: str = "") -> None:
    """Progress inside a unit stays on its worker."""
