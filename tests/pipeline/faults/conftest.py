"""Faults of disks, made by the kernel itself: small and read-only file systems."""

import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from cli import main

BLOCK_BYTES = 4096
BALLAST = "ballast"
Infgen = Callable[..., tuple[int, str]]


@dataclass(frozen=True)
class SmallDisk:
    """A file system of limited size.

    Attributes:
        folder: Where it is mounted.
    """

    folder: Path

    def fill(self, free_blocks: int = 0) -> None:
        """Use up all space but some blocks of 4 KiB."""
        size = self._free_bytes() - free_blocks * BLOCK_BYTES
        (self.folder / BALLAST).write_bytes(b"\1" * size)

    def empty(self) -> None:
        """Free that space again."""
        (self.folder / BALLAST).unlink()

    def _free_bytes(self) -> int:
        done = subprocess.run(
            ["stat", "--file-system", "--format=%a %S", str(self.folder)],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        blocks, size = map(int, done.stdout.split())
        return blocks * size


def mount(*words: str) -> None:
    """Mount a file system, or skip the test where that is not allowed."""
    done = subprocess.run(["mount", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"mounting needs privileges: {done.stderr.strip()}")


@pytest.fixture
def small_disk() -> Iterator[Callable[..., SmallDisk]]:
    """``small_disk(folder, size="1m")``: a tmpfs of that size, mounted on a folder."""
    mounted: list[Path] = []

    def make(folder: Path, **options: str) -> SmallDisk:
        folder.mkdir(parents=True, exist_ok=True)
        words = ",".join(f"{name}={value}" for name, value in options.items())
        mount("-t", "tmpfs", "-o", words, "tmpfs", str(folder))
        mounted.append(folder)
        return SmallDisk(folder)

    yield make
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def read_only() -> Iterator[Callable[[Path], None]]:
    """``read_only(folder)``: mount a folder over itself, so that nothing can be written."""
    mounted: list[Path] = []

    def make(folder: Path) -> None:
        mount("--bind", str(folder), str(folder))
        mounted.append(folder)
        mount("-o", "remount,bind,ro", str(folder))

    yield make
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def infgen(workshop, capsys) -> Infgen:
    """``infgen("run", ...)`` on the toys' root gives exit code and error output."""

    def call(*words: str) -> tuple[int, str]:
        place = ("--root", str(workshop.root.path), "--file", str(workshop.file))
        records = ("--records", f"{workshop.texts}/*.txt")
        with pytest.raises(SystemExit) as left:
            main([*words, *place, *records])
        return left.value.code or 0, capsys.readouterr().err

    return call


@pytest.fixture
def expected(workshop, tmp_path_factory) -> Mapping[str, bytes]:
    """What the toys make where nothing goes wrong."""
    quiet = type(workshop)(tmp_path_factory.mktemp("quiet"))
    quiet.file.write_text(workshop.file.read_text())
    quiet.texts.mkdir()
    for path in workshop.texts.iterdir():
        quiet.text(path.name, path.read_text())
    quiet.run()
    return quiet.files()
