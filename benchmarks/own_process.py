"""What a command uses that runs in a process of its own.

The caller must be small: its memory at the start of a process counts as the process's.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

TAIL = 2000
"""Characters of a failed command's errors that are shown."""
ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS"),
    "1",
)


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process used, with those that it started.

    Attributes:
        wall_s: Seconds of the clock.
        cpu_s: Seconds of a core.
        peak_mib: Most memory held by one of them.
        text: Its standard output.
    """

    wall_s: float
    cpu_s: float
    peak_mib: float
    text: str


def measure(words: Sequence[str], folder: Path) -> Usage:
    """Run a Python command to its end.

    Args:
        words: Arguments of the interpreter.
        folder: Where it runs; its output is kept there for a moment.

    Raises:
        RuntimeError: if it fails, with the end of what it wrote to standard error.
    """
    output, errors = folder / "stdout.txt", folder / "stderr.txt"
    with output.open("w") as out, errors.open("w") as err:
        begun = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *words],
            cwd=folder,
            env={**os.environ, **ENVIRONMENT},
            stdout=out,
            stderr=err,
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - begun
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(
            f"{' '.join(words)} ended with {process.returncode}, expected 0: "
            f"{errors.read_text()[-TAIL:]}"
        )
    cpu_s = usage.ru_utime + usage.ru_stime
    return Usage(wall_s, cpu_s, usage.ru_maxrss / 1024, output.read_text())
