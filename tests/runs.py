"""Runs of the command line in processes of their own, to be killed for good."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol

from cli import main
from pipeline.engine.registry import MODULES, load_stage

HERE = Path(__file__).resolve().parents[1]
IMPORTED = ("numpy", "torch", "polars", "zarr", "infgen.model.network")
POLL_S = 0.005


class Run(Protocol):
    """One run, in a session and process group of its own.

    Attributes:
        pid: Its process, and group.
        returncode: Its exit code, or minus the signal that ended it; None while it runs.
    """

    pid: int
    returncode: int | None

    def poll(self) -> int | None:
        """Return the exit code if it has ended."""


class StartedRun(subprocess.Popen):
    """A run in a new Python process.

    Args:
        words: Of the command line.
        said: File that gets all it says.
    """

    def __init__(self, words: Sequence[str], said: Path) -> None:
        with said.open("w") as log:
            super().__init__(
                [sys.executable, "-m", "infgen", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": str(HERE)},
                start_new_session=True,
            )


class ForkedRun:
    """A run in a fork of this process, which imports everything once: it starts at once.

    A fork inherits no threads. So only a process that computes nothing itself may use this.

    Args:
        words: Of the command line.
        said: File that gets all it says.
    """

    def __init__(self, words: Sequence[str], said: Path) -> None:
        import_all()
        self.returncode: int | None = None
        sys.stdout.flush()
        self.pid = os.fork()
        if not self.pid:
            _run(words, said)

    def poll(self) -> int | None:
        """Return the exit code if it has ended."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


def wait(run: Run, longest_s: float) -> None:
    """Wait until a run has ended.

    Raises:
        TimeoutError: if it takes longer than that.
    """
    begun = time.monotonic()
    while run.poll() is None:
        if time.monotonic() - begun > longest_s:
            raise TimeoutError(f"process {run.pid} runs for more than {longest_s} s")
        time.sleep(POLL_S)


def import_all() -> None:
    """Import what runs import, once."""
    for name in IMPORTED:
        import_module(name)
    for module in MODULES.values():
        load_stage(module)


def _run(words: Sequence[str], said: Path) -> None:
    """Run the command line in this fork, and leave."""
    code = 70  # As of an internal error (EX_SOFTWARE).
    try:
        os.setsid()
        handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        main(list(words))
        code = 0
    except SystemExit as left:
        code = int(left.code or 0)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
