"""A Dask scheduler and its workers as processes of their own, as on any cluster."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

LOOPBACK = "127.0.0.1"
POLL_S = 0.05


@dataclass
class Cluster:
    """A scheduler, and workers below processes that restart them.

    Attributes:
        folder: Where its files are.
        paths: Folders that its processes import from.
        memory_limit: Of each worker, in Dask's words; 0 for none.
        environment: More of it.
    """

    folder: Path
    paths: Sequence[str]
    memory_limit: str = "0"
    environment: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._scheduler: subprocess.Popen | None = None
        self._workers: list[subprocess.Popen] = []

    @property
    def words(self) -> str:
        """How a run is told of it."""
        return f"file:{self._file}"

    @property
    def _file(self) -> Path:
        return self.folder / "scheduler.json"

    def start(self, workers: int) -> None:
        """Start it; return when there is a scheduler."""
        self._file.unlink(missing_ok=True)
        there = ("--scheduler-file", str(self._file), "--no-dashboard")
        where = ("--host", LOOPBACK, "--port", "0")
        self._scheduler = self._start("scheduler", *where, *there)
        how = ("--nthreads", "1", "--memory-limit", self.memory_limit)
        # One command each: a worker killed while it starts takes all of its command along.
        self._workers = [self._start("worker", *how, *there) for _ in range(workers)]
        while not self._file.is_file():
            time.sleep(POLL_S)

    def _start(self, what: str, *words: str) -> subprocess.Popen:
        more = {"PYTHONPATH": os.pathsep.join(self.paths), **self.environment}
        with (self.folder / f"{what}.log").open("a") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", what, *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **more},
                start_new_session=True,
            )

    def kill_scheduler(self) -> None:
        """End the scheduler at once."""
        os.killpg(self._scheduler.pid, signal.SIGKILL)

    def freeze_scheduler(self) -> None:
        """Stop the scheduler: its connections stay, and nothing is answered."""
        os.killpg(self._scheduler.pid, signal.SIGSTOP)

    def kill_worker(self, number: int) -> None:
        """End one worker at once; whoever watches over it starts another."""
        while not (working := self._working()):
            time.sleep(POLL_S)
        os.kill(working[number % len(working)], signal.SIGKILL)

    def kill_workers(self) -> None:
        """End all workers at once; their supervisors start others."""
        while not (working := self._working()):
            time.sleep(POLL_S)
        for process in working:
            os.kill(process, signal.SIGKILL)

    def freeze_worker(self, number: int) -> None:
        """Stop one worker: its connections stay, and it does nothing more."""
        while not (working := self._working()):
            time.sleep(POLL_S)
        os.kill(working[number % len(working)], signal.SIGSTOP)

    def _working(self) -> list[int]:
        """Process numbers of the workers themselves."""
        found = []
        for command in self._workers:
            for child in psutil.Process(command.pid).children():
                with contextlib.suppress(psutil.Error):  # It has just ended.
                    if "spawn_main" in " ".join(child.cmdline()):
                        found.append(child.pid)
        return found

    def stop(self) -> None:
        """End all of it."""
        for process in filter(None, (*self._workers, self._scheduler)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
