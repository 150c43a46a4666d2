"""Dask workers: on this machine, on its GPUs, or on any cluster.

Workers write their results to disk themselves and return a few figures.
"""

import logging
import os
import re
import time
import traceback
import uuid
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from queue import SimpleQueue
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.units import (
    DriverWorkers,
    Executor,
    InProcess,
    Outcome,
    Task,
    Workers,
    WorkersLostError,
)
from pipeline.workers.gpus import (
    GRAMMAR,
    VISIBLE_DEVICES,
    is_gpu_words,
    select_gpus,
    worker_names,
)
from pipeline.workers.scheduling import (
    RETRIES,
    DeviceFailed,
    PoolExecutor,
    TaskEnded,
    TaskFailure,
    TaskProgress,
    TimeLimitExceeded,
    WorkerEvent,
    WorkerLost,
    WorkerMemoryFull,
)
from pipeline.workers.worker_side import (
    DEVICE,
    DEVICE_TOPIC,
    PROGRESS_TOPIC,
    TIMEOUT_TOPIC,
    run_with_progress,
)

HELP = f"none | local[:N] | {GRAMMAR} | tcp://HOST:PORT | file:scheduler.json"
LOOPBACK = "127.0.0.1"  # Dask runs what anyone who connects sends it.
WEB: dict[str, Any] = {"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"}
"""A free port for the scheduler's web server: another cluster may use the default one."""
SCHEDULER_TIMEOUT_S = 60.0
"""Longest wait for an answer of the scheduler."""
CLOSE_S, POLL_S = 10.0, 0.1
CONFIG = {
    # A worker that is just being restarted when this time is up is given up for good; with
    # the usual 15 seconds a few crashes leave a cluster without workers.
    "distributed.deploy.lost-worker-timeout": "1 day",
    # Workers of our own are lost by what they do, and that is tried again alone.
    "distributed.scheduler.allowed-failures": 1,
}
WORKER_ENVIRONMENT = {"ZARR_ASYNC__CONCURRENCY": "4", "ZARR_THREADING__MAX_WORKERS": "2"}
WORKERS_TOPIC, MEMORY_TOPIC = "all", "worker-restart-memory"
"""Dask's topics for workers that start and end, and for those it restarts."""


def choose_workers(
    words: str, visible_devices: str | None = None, unit_limit_s: float = 0.0
) -> Workers:
    """Return the workers that a word of the command line names.

    Args:
        words: As on the command line (``--dask``).
        visible_devices: ``CUDA_VISIBLE_DEVICES`` of this process, if it is set.
        unit_limit_s: Longest time of a unit on a Dask worker; 0 for any.

    Raises:
        ConfigError: for words that name no kind of workers.
    """
    if words == "none":
        return DriverWorkers()
    return DaskWorkers(words, visible_devices, unit_limit_s)


@dataclass(frozen=True, slots=True)
class DaskWorkers:
    """Workers of a Dask cluster: on this machine, on its GPUs, or anywhere.

    Attributes:
        words: As on the command line.
        visible_devices: ``CUDA_VISIBLE_DEVICES`` of this process, if it is set.
        unit_limit_s: Longest time of a unit; 0 for any.
    """

    words: str
    visible_devices: str | None = None
    unit_limit_s: float = 0.0

    def __post_init__(self) -> None:
        """Check the word.

        Raises:
            ConfigError: naming the words and those there are.
        """
        parse(self.words)

    @contextmanager
    def open(self) -> Iterator["OpenDaskWorkers"]:
        """Start the cluster with the first unit that needs it; the context stops it."""
        with ExitStack() as stack:
            yield OpenDaskWorkers(self, stack)


class OpenDaskWorkers:
    """A cluster that starts only when the first unit needs it.

    Args:
        workers: Which cluster.
        stack: Closes it.
    """

    def __init__(self, workers: DaskWorkers, stack: ExitStack) -> None:
        self._workers, self._stack = workers, stack
        self._executor: Executor | None = None

    def executor(self, *, here: bool) -> Executor:
        """Return the executor of a stage's units; with ``here``, one in this process."""
        if here:
            return InProcess()
        if self._executor is None:
            words, visible = self._workers.words, self._workers.visible_devices
            client = self._stack.enter_context(_client(words, visible))
            pool = DaskPool(client, self._workers.unit_limit_s)
            self._stack.callback(pool.close)
            self._executor = PoolExecutor(pool)
        return self._executor


def parse(words: str) -> tuple[str, str]:
    """Split ``local:4`` into kind and rest; of ``gpu*2`` the rest is ``*2``.

    Raises:
        ConfigError: for words that name no kind of workers.
    """
    if is_gpu_words(words):
        return "gpu", words.removeprefix("gpu").removeprefix(":")
    if not re.fullmatch(r"local(:[1-9]\d*)?|(tcp|tls|file):.+", words):
        raise ConfigError(f"--dask {words}: expected {HELP}")
    kind, _, rest = words.partition(":")
    return kind, rest


@contextmanager
def _client(words: str, visible: str | None) -> Iterator[Any]:
    kind, rest = parse(words)
    place: dict[str, Any] = {"address": words}
    with ExitStack() as stack:
        _dask()  # First: it adds to the settings that are put back in the end.
        stack.enter_context(import_module("dask").config.set(CONFIG))
        if kind == "local":
            cluster = _local(int(rest or os.cpu_count() or 1))
            place = {"address": stack.enter_context(cluster)}
        elif kind == "gpu":
            cluster = _gpus(select_gpus(rest, visible))
            place = {"address": stack.enter_context(cluster)}
        elif kind == "file":
            place = {"scheduler_file": _await_file(rest)}
        client = _connect(words, place)
        stack.callback(_close, client)
        client.get_versions(check=True)
        yield client


def _close(client: Any) -> None:
    with suppress(OSError):  # Nobody waits for a scheduler that does not answer.
        client.close(timeout=CLOSE_S)


def _await_file(path: str) -> str:
    """Wait for the file that a scheduler writes; Dask would wait without limit."""
    begun = time.monotonic()
    while not os.path.exists(path):
        if time.monotonic() - begun > SCHEDULER_TIMEOUT_S:
            raise WorkersLostError(f"no Dask scheduler has written {path}: start one")
        time.sleep(POLL_S)
    return path


def _connect(words: str, place: Mapping[str, Any]) -> Any:
    try:
        return _dask().Client(**place, set_as_default=False)
    except OSError as error:
        raise WorkersLostError(f"the Dask scheduler {words} does not answer") from error


def _dask() -> Any:
    """Import Dask when it is needed: it takes more than a second and is not typed."""
    return import_module("distributed")


def _local(count: int) -> Any:
    return _dask().LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        memory_limit=_memory_bytes(count),
        host=LOOPBACK,
        dashboard_address=WEB["dashboard_address"],
        scheduler_kwargs={"dashboard": WEB["dashboard"]},
        silence_logs=logging.ERROR,
        env=WORKER_ENVIRONMENT,
    )


def _memory_bytes(workers: int) -> int:
    """Memory limit of each of some workers on this machine."""
    return int(import_module("distributed.system").MEMORY_LIMIT) // workers


def _gpus(devices: Sequence[str]) -> Any:
    options = {"host": LOOPBACK, **WEB}
    scheduler = {"cls": _dask().Scheduler, "options": options}
    return _dask().SpecCluster(workers=gpu_workers(devices), scheduler=scheduler)


def gpu_workers(devices: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Describe one worker process per name of a device, which sees that device alone.

    The environment is set before anything is imported there.

    Args:
        devices: The device of every worker; repeated where it gets several.
    """
    return {
        name: {
            "cls": _dask().Nanny,
            "options": {
                "host": LOOPBACK,
                "nthreads": 1,
                "memory_limit": _memory_bytes(len(devices)),
                "resources": {DEVICE: 1 / devices.count(device)},
                "env": {**WORKER_ENVIRONMENT, VISIBLE_DEVICES: device},
            },
        }
        for name, device in worker_names(devices).items()
    }


class DaskPool:
    """The workers of a Dask client, as a ``WorkerPool``.

    Args:
        client: Of Dask, which is not typed.
        unit_limit_s: Longest time of a unit; 0 for any.
    """

    def __init__(self, client: Any, unit_limit_s: float = 0.0) -> None:
        self._client, self._unit_limit_s = client, unit_limit_s
        self._futures: dict[str, Any] = {}
        self._inbox: SimpleQueue[WorkerEvent] = SimpleQueue()
        # Two runs on one cluster may do units of one name, for two roots.
        self._mark = uuid.uuid4().hex[:8]
        self._topics = {
            WORKERS_TOPIC: self._on_worker_event,
            MEMORY_TOPIC: self._on_memory_full,
            f"{PROGRESS_TOPIC}-{self._mark}": self._on_progress,
            f"{DEVICE_TOPIC}-{self._mark}": self._on_device_failed,
            f"{TIMEOUT_TOPIC}-{self._mark}": self._on_timeout,
        }
        for topic, hear in self._topics.items():
            client.subscribe_topic(topic, hear)

    def close(self) -> None:
        """Stop listening to the cluster's topics."""
        if self._client.status == "running":
            for topic in self._topics:
                self._client.unsubscribe_topic(topic)

    @property
    def inbox(self) -> "SimpleQueue[WorkerEvent]":
        """Events of the workers, in order of arrival."""
        return self._inbox

    def begin(self, name: str, task: Task) -> None:
        """Submit a task as an attempt of that name."""
        key = f"{name}-{self._mark}"
        arguments = (task, key, self._mark, self._unit_limit_s)
        future = self._client.submit(
            _run_on_worker, *arguments, key=key, retries=RETRIES, pure=False
        )
        self._futures[key] = future
        future.add_done_callback(lambda _: self._inbox.put(TaskEnded(name)))

    def take(self, name: str) -> Outcome | TaskFailure:
        """Return the result of an attempt that has ended.

        Raises:
            WorkersLostError: if the scheduler does not know.
        """
        future = self._futures.pop(f"{name}-{self._mark}")
        try:
            if future.status == "finished":
                outcome: Outcome = future.result()
                return outcome
            error = future.exception() if future.status == "error" else None
        except (OSError, CancelledError) as lost:
            raise self._lost() from lost
        if error is None:
            raise self._lost()
        trace = "".join(traceback.format_tb(future.traceback()))
        return TaskFailure(error, trace, isinstance(error, _dask().KilledWorker))

    def threads(self) -> int:
        """Return the number of tasks that run at once.

        Raises:
            WorkersLostError: if the scheduler does not answer.
        """
        client = self._client
        if client.status != "running":
            raise self._lost()
        try:
            found = client.sync(
                client.scheduler.ncores, callback_timeout=SCHEDULER_TIMEOUT_S
            )
        except OSError as error:
            raise self._lost() from error
        return sum(found.values())

    def _lost(self) -> WorkersLostError:
        where = getattr(self._client.scheduler, "address", "of this run")
        return WorkersLostError(
            f"the Dask scheduler {where} is lost; what is done is kept: run again when "
            "there is one"
        )

    def _on_worker_event(self, event: tuple[float, Mapping[str, Any]]) -> None:
        """Report a worker that ended, with its attempts."""
        about = event[1]
        if about.get("action") == "remove-worker" and not about.get("expected"):
            keys = map(str, about.get("processing-tasks", ()))
            ours = [key for key in keys if key.endswith(self._mark)]
            names = tuple(key.removesuffix(f"-{self._mark}") for key in ours)
            self._inbox.put(WorkerLost(str(about["worker"]), names))

    def _on_memory_full(self, event: tuple[float, Mapping[str, Any]]) -> None:
        about = event[1]
        self._inbox.put(WorkerMemoryFull(str(about["worker"]), int(about["rss"])))

    def _on_progress(self, event: tuple[float, Mapping[str, Any]]) -> None:
        about = event[1]
        name = str(about["key"]).removesuffix(f"-{self._mark}")
        self._inbox.put(TaskProgress(name, about["done"], about["total"], about["note"]))

    def _on_device_failed(self, event: tuple[float, Mapping[str, Any]]) -> None:
        about = event[1]
        name = str(about["key"]).removesuffix(f"-{self._mark}")
        self._inbox.put(DeviceFailed(name, str(about["reason"])))

    def _on_timeout(self, event: tuple[float, Mapping[str, Any]]) -> None:
        about = event[1]
        name = str(about["key"]).removesuffix(f"-{self._mark}")
        self._inbox.put(TimeLimitExceeded(name, float(about["limit_s"])))


def _run_on_worker(task: Task, key: str, mark: str, limit_s: float) -> Outcome:
    """Do a task on the worker that this runs on."""
    return run_with_progress(_dask().get_worker(), task, key, mark, limit_s)
