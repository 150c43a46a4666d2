"""A process that reads tables, as some damaged ones end the process that reads them.

Polars ends its process where a damaged table asks for more memory than there is. Here that
is a process of its own, which is started with the first table and ends with its parent:
it gets requests on standard input and answers on standard output. A request is a line of
JSON (kind, columns, number of bytes) and the file's bytes; an answer is a line of JSON with
an error, or one that describes the columns whose bytes follow.
"""

import atexit
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from infgen.sources.tfrecord import RecordError

Columns = Mapping[str, str]
Read = Callable[[str, bytes, Columns], Mapping[str, np.ndarray]]
"""Reads columns, of the types that they are to have, of a table of some kind."""
_ATTEMPTS = 2
"""Another process may have been ended by something else, as when memory ran out."""


@dataclass
class TableProcess:
    """The process, and who may talk to it.

    Attributes:
        command: What is run.
        process: The process; None before it is needed.
        owner: Process id of who started it. A fork starts one of its own.
        lock: Held from a request to its answer.
    """

    command: tuple[str, ...] = (sys.executable, "-m", "infgen.sources.argoverse2")
    process: "subprocess.Popen[bytes] | None" = None
    owner: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self, kind: str, data: bytes, columns: Columns) -> dict[str, np.ndarray]:
        """Read columns, of the types that they are to have, of a table of some kind.

        Raises:
            RecordError: if it is no such table, or reading it ends the process.
        """
        about = {"kind": kind, "columns": dict(columns), "bytes": len(data)}
        with self.lock:
            for _ in range(_ATTEMPTS):
                process = self._running()
                try:
                    answer = _ask(process, about, data)
                except OSError:
                    code = self.end()
                except BaseException:  # Its answer would be taken for the next one's.
                    self.end()
                    raise
                else:
                    break
            else:
                raise RecordError(
                    f"not a usable {kind} table: reading it ended the reader ({code})"
                )
        if isinstance(answer, str):
            raise RecordError(answer)
        return answer

    def end(self) -> int | None:
        """End the process; return its exit status."""
        process, self.process = self.process, None
        if process is None or self.owner != os.getpid():
            return None
        process.kill()
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):  # What was not sent is not missed.
                pipe.close()  # type: ignore[union-attr]
        return process.wait()

    def _running(self) -> "subprocess.Popen[bytes]":
        if self.process is None or self.owner != os.getpid():
            self.owner = os.getpid()
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # Rust's panics; the answer has their message.
                cwd=Path(__file__).parents[3],  # Where it finds this package.
                start_new_session=True,  # Who interrupts a run interrupts no table.
            )
        return self.process


def serve(read: Read, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Answer requests until there are no more."""
    while line := requests.readline():
        about = json.loads(line)
        data = requests.read(about["bytes"])
        try:
            found = read(about["kind"], data, about["columns"])
        except RecordError as error:
            _send(answers, {"error": str(error)}, b"")
            continue
        _send(answers, *_pack(found))


def _ask(
    process: "subprocess.Popen[bytes]", about: Mapping[str, Any], data: bytes
) -> dict[str, np.ndarray] | str:
    """Return the columns, or what is wrong with the table.

    Raises:
        OSError: if the process has ended.
    """
    assert process.stdin is not None
    assert process.stdout is not None
    _send(process.stdin, about, data)
    line = process.stdout.readline()
    if not line.endswith(b"\n"):
        raise BrokenPipeError
    answer = json.loads(line)
    if "error" in answer:
        return str(answer["error"])
    packed = process.stdout.read(answer["bytes"])
    if len(packed) < answer["bytes"]:
        raise BrokenPipeError
    return _unpack(answer, packed)


def _pack(columns: Mapping[str, np.ndarray]) -> tuple[dict[str, Any], bytes]:
    """Return what describes columns, and their bytes.

    Of text the description has each word once, and the bytes which one each row has.
    """
    described, parts = [], []
    for name, values in columns.items():
        place: dict[str, int] = {}
        if values.dtype == object:
            rows = [place.setdefault(word, len(place)) for word in values.tolist()]
            values = np.array(rows, np.int32)
        parts.append(values.tobytes())
        about = {"name": name, "type": values.dtype.str, "rows": len(values)}
        described.append({**about, "words": list(place)})
    data = b"".join(parts)
    return {"columns": described, "bytes": len(data)}, data


def _unpack(about: Mapping[str, Any], data: bytes) -> dict[str, np.ndarray]:
    """Read columns that ``_pack`` described; arrays can be written to."""
    columns, offset = {}, 0
    for part in about["columns"]:
        values = np.frombuffer(data, part["type"], part["rows"], offset)
        offset += values.nbytes
        words = np.array(part["words"], object)
        columns[part["name"]] = words[values] if len(words) else values.copy()
    return columns


def _send(file: IO[bytes], about: Mapping[str, Any], data: bytes) -> None:
    file.write(json.dumps(about).encode() + b"\n")
    file.write(data)
    file.flush()


TABLES = TableProcess()
"""The one of this process."""
atexit.register(TABLES.end)
