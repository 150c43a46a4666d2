"""Description of this machine for the run record. Reads files only."""

import os
import platform
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

CPUS = Path("/proc/cpuinfo")
GPUS = Path("/proc/driver/nvidia/gpus")
GIB = 1 << 30
_MODEL = re.compile(r"^(?:model name|Model)\s*:\s*(.+?)\s*$", re.MULTILINE)


@cache
def describe() -> dict[str, Any]:
    """Processor, cores, memory and graphics processors of this machine."""
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": next(_models(CPUS), platform.processor() or "unknown"),
        "cores": os.cpu_count(),
        "memory_gib": round(memory_bytes / GIB, 1),
        "gpus": [name for card in _cards() for name in _models(card)],
    }


def _cards() -> list[Path]:
    return sorted(GPUS.glob("*/information"))


def _models(path: Path) -> Iterator[str]:
    """Names of the models that a file of the kernel lists."""
    try:
        yield from _MODEL.findall(path.read_text())
    except OSError:  # Not Linux.
        return
