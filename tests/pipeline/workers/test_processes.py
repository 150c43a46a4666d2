import os
import subprocess
import sys

from pipeline.workers import processes
from pipeline.workers.processes import memory_bytes


def status(folder, pid, parent, kib=None):
    """Write what the kernel tells of a process."""
    (folder / str(pid)).mkdir(parents=True)
    resident = f"VmRSS:\t  {kib} kB\n" if kib is not None else ""
    (folder / str(pid) / "status").write_text(f"Name:\tpy (x)\nPPid:\t{parent}\n{resident}")


def test_memory_is_that_of_a_process_and_all_below_it(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "PROC", tmp_path)
    status(tmp_path, 1, 0, kib=900)
    status(tmp_path, 10, 1, kib=100)
    status(tmp_path, 11, 10, kib=20)
    status(tmp_path, 12, 11, kib=3)
    status(tmp_path, 13, 10)  # Ended, and not asked after yet.
    status(tmp_path, 20, 1, kib=5000)
    (tmp_path / "30").mkdir()

    assert memory_bytes(10) == 123 * 1024
    assert memory_bytes(13) == 0
    assert memory_bytes(99) is None


def test_without_proc_nothing_is_known(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "PROC", tmp_path / "none")

    assert memory_bytes(os.getpid()) is None


def test_a_child_counts_with_this_process():
    alone = memory_bytes(os.getpid())
    code = "import sys; block = bytearray(b'x') * (64 << 20); print(); sys.stdin.read()"
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    child.stdout.readline()
    together = memory_bytes(os.getpid())
    child.communicate(b"")

    assert together - alone > 60 << 20
