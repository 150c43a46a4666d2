"""CUDA devices of this machine: which ones get worker processes, and how many each."""

import re
from collections import Counter
from collections.abc import Sequence
from contextvars import ContextVar

from infgen.errors import ConfigError

GRAMMAR = "gpu[*N] | gpu:0[*N],1[*N]"
"""``gpu``: one worker per device; ``*N``: so many on each, or on the device before it."""
WORDS = r"gpu(\*[1-9]\d*)?|gpu:\d+(\*[1-9]\d*)?(,\d+(\*[1-9]\d*)?)*"
VISIBLE_DEVICES = "CUDA_VISIBLE_DEVICES"
DEVICE_SHARE = ContextVar("DEVICE_SHARE", default=1.0)
"""The part of its device that the worker which does the present task may use."""
MAX_WORKERS = 48
"""Clients of one device under CUDA MPS (NVIDIA's manual, Volta and later)."""


def select_gpus(wanted: str, visible: str | None) -> list[str]:
    """Return the device of every worker to start; devices with several are repeated.

    Args:
        wanted: As after ``gpu`` on the command line: empty for one worker on each device,
            ``*6`` for six on each, or numbers as this process counts devices, such as
            ``0*6,1``.
        visible: ``CUDA_VISIBLE_DEVICES`` of this process, by which devices are renumbered.

    Raises:
        ConfigError: if there is no such device, one is named twice, or has too many.
    """
    import torch  # noqa: PLC0415

    count = torch.cuda.device_count()
    words = f"--dask gpu{wanted if wanted[:1] in ('', '*') else f':{wanted}'}"
    if not count:
        raise ConfigError(
            f"{words}: this machine has no CUDA device that torch can use; try --dask local"
        )
    named = [_workers_of(part) for part in _spelled_out(wanted, count).split(",")]
    numbers = [number for number, _ in named]
    if max(numbers) >= count or len(set(numbers)) < len(numbers):
        raise ConfigError(
            f"{words}: expected different numbers from 0 to {count - 1}, one per CUDA "
            f"device; {_several(numbers)}*N starts N workers on a device ({GRAMMAR})"
        )
    most = max(workers for _, workers in named)
    if most > MAX_WORKERS:
        raise ConfigError(
            f"{words}: {most} workers on one device; expected {MAX_WORKERS} at most, as "
            f"many as CUDA MPS takes ({GRAMMAR})"
        )
    names = visible.split(",") if visible else [str(number) for number in range(count)]
    return [names[number].strip() for number, workers in named for _ in range(workers)]


def _spelled_out(wanted: str, count: int) -> str:
    """Name every device: ``*2`` on two devices is ``0*2,1*2``."""
    if wanted[:1] in ("", "*"):
        return ",".join(f"{number}{wanted}" for number in range(count))
    return wanted


def _workers_of(part: str) -> tuple[int, int]:
    """Split ``0*6`` into the number of a device and its number of workers."""
    number, _, workers = part.partition("*")
    return int(number), int(workers or 1)


def _several(numbers: Sequence[int]) -> str:
    """An example for the message: a device that was named twice, or the first one."""
    (number, times), *_ = Counter(numbers).most_common(1)
    return f"gpu:{number if times > 1 else 0}"


def worker_names(devices: Sequence[str]) -> dict[str, str]:
    """Name workers after their devices: ``0``, or ``0-0`` and ``0-1`` where it has two.

    Returns:
        The device of each worker.
    """
    several, seen = Counter(devices), Counter[str]()
    found = {}
    for device in devices:
        name = f"{device}-{seen[device]}" if several[device] > 1 else device
        seen[device] += 1
        found[name] = device
    return found


def is_gpu_words(words: str) -> bool:
    """Whether words of ``--dask`` name workers on CUDA devices."""
    return re.fullmatch(WORDS, words) is not None
