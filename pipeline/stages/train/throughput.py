"""How fast training goes: said now and then, and kept apart from what is reproducible."""

import json
import resource
import time
from pathlib import Path

import torch

from pipeline.engine.stage import Progress

TELL_EVERY_S = 0.5
KIB_PER_MIB = 1024


class ThroughputMeter:
    """Measures throughput: progress at a readable rate, and figures for the record.

    What it notes goes below the folder ``run``, which no manifest lists.
    """

    def __init__(self, path: Path, steps: int, first: int, scenes: int) -> None:
        self._path, self._steps, self._scenes = path, steps, scenes
        self._told = self._noted = (first, time.monotonic())
        self._begun = self._told
        path.parent.mkdir(parents=True, exist_ok=True)

    def due(self, done: int) -> bool:
        """Whether it is time to tell: now and then, and at the end."""
        return time.monotonic() - self._told[1] >= TELL_EVERY_S or done == self._steps

    def tell(self, done: int, loss: float, progress: Progress) -> None:
        """Report steps done. Here a request to stop arrives, as ``Stopped``."""
        rate = self._rate(self._told, done)
        self._told = (done, time.monotonic())
        note = f"loss {loss:.3f}, {rate:.3g} scenes/s, {peak_memory_mib() / 1024:.2g} GiB"
        progress(done, self._steps, note)

    def note(self, done: int) -> dict[str, int | float]:
        """Write the figures since the last note, as one line of JSON, and return them."""
        found: dict[str, int | float] = {
            "step": done,
            "scenes_per_s": round(self._rate(self._noted, done), 3),
            "peak_memory_mib": round(peak_memory_mib(), 1),
        }
        self._noted = (done, time.monotonic())
        with self._path.open("a") as file:
            file.write(json.dumps({"time": round(time.time(), 1), **found}) + "\n")
        return found

    def overall(self, done: int) -> float:
        """Scenes per second from the first step of this process on."""
        return self._rate(self._begun, done)

    def _rate(self, since: tuple[int, float], done: int) -> float:
        passed_s = max(time.monotonic() - since[1], 1e-9)
        return (done - since[0]) * self._scenes / passed_s


def peak_memory_mib() -> float:
    """Most memory used so far: of the GPU if there is one, else of the process."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / (1 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB_PER_MIB
