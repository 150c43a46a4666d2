"""Memory of a run's processes, read from ``/proc`` (Linux only)."""

import re
from collections.abc import Iterator
from pathlib import Path

PROC = Path("/proc")
BYTES_PER_KIB = 1024
_STATUS_LINES = re.compile(r"^(PPid|VmRSS):\s+(\d+)", re.MULTILINE)


def memory_bytes(pid: int) -> int | None:
    """Resident memory of a process and all below it, as ``top`` shows it.

    Shared memory counts once for each process.

    Returns:
        Bytes; None without such a process or without ``/proc``.
    """
    parents, resident = {}, {}
    for number, facts in _processes():
        parents[number] = facts.get("PPid", 0)
        resident[number] = facts.get("VmRSS", 0) * BYTES_PER_KIB
    if pid not in resident:
        return None
    return sum(size for one, size in resident.items() if _is_below(one, pid, parents))


def _processes() -> Iterator[tuple[int, dict[str, int]]]:
    for path in PROC.glob("[0-9]*/status"):
        try:
            text = path.read_text()
        except OSError:  # The process has ended.
            continue
        facts = {name: int(value) for name, value in _STATUS_LINES.findall(text)}
        yield int(path.parent.name), facts


def _is_below(one: int, top: int, parents: dict[int, int]) -> bool:
    """Whether a process is ``top`` or was started by it, directly or not."""
    seen = set()
    while one != top and one in parents and one not in seen:
        seen.add(one)
        one = parents[one]
    return one == top
