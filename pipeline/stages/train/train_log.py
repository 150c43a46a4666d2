"""The log of a training run: a JSON object per line, the same however often it stopped."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.engine.atomic import write_file


class TrainLog:
    """Lines that wait in memory until ``flush`` puts them on disk.

    What a killed run wrote beyond its last checkpoint is cut off when it goes on.

    Args:
        path: Of the file.
        first: Step of that checkpoint.
        validated: Whether that step is validated before it is saved. What a later
            validation wrote, the final one of the last step, is cut off, too.
    """

    def __init__(self, path: Path, first: int, *, validated: bool = True) -> None:
        self._path = path
        self._waiting: list[str] = []
        lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
        kept = [line for line in lines if _is_before(line, first)]
        found = sum(_is_validation(line, first) for line in kept)
        if found > validated:
            kept.pop()
        write_file(path, "".join(kept).encode())

    def add(self, line: Mapping[str, Any]) -> None:
        """Add a line; it has a ``step``."""
        self._waiting.append(json.dumps(line) + "\n")

    def flush(self) -> None:
        """Put all lines so far on disk."""
        with self._path.open("a") as file:
            file.write("".join(self._waiting))
            file.flush()
            os.fsync(file.fileno())
        self._waiting = []


def read_log(path: Path) -> list[dict[str, Any]]:
    """Read all whole lines of a log, in order."""
    return [json.loads(line) for line in path.read_text().splitlines() if _is_whole(line)]


def _is_whole(line: str) -> bool:
    return line.startswith("{") and line.rstrip().endswith("}")


def _is_validation(line: str, step: int) -> bool:
    about = json.loads(line)
    return "validation" in about and int(about["step"]) == step


def _is_before(line: str, step: int) -> bool:
    """Tell whether a line is whole and of a step up to this one."""
    if not line.endswith("\n") or not _is_whole(line):
        return False
    return int(json.loads(line)["step"]) <= step
