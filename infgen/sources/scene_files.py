"""Sources that keep a scene in files of its own: what a module of one provides.

A source is a module (or package) with three functions, ``find``, ``label`` and ``read``,
that is listed in ``registry``. Nothing else of it is called. ``docs/own-source.md`` writes
one.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from infgen.scene import Scene
from infgen.sources.tfrecord import RecordError

MAX_FILE_BYTES = 128 << 20
"""Longer files are refused; the largest real scene is about 3 MB."""
HEAD_BYTES = 16
"""Bytes at the start of a file by which formats are told apart."""

_SPLITS = {
    "train": "training",
    "training": "training",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
    "test": "testing",
    "testing": "testing",
}
"""Words of folders and data sets, and WOMD's name of the split, which settings use."""


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """The files that hold one scene.

    Attributes:
        name: Of the scene in messages and tables: its folder or file, and the one above.
        paths: Local files (URLs where they are found, not read), in the order in which the
            source lists them.
    """

    name: str
    paths: tuple[str, ...]


class Label(NamedTuple):
    """What is known of a scene before it is read.

    Attributes:
        split: ``training``, ``validation``, ``testing``, or the name of the data set where
            nothing says more.
        scenario_id: Of the scene.
    """

    split: str
    scenario_id: str


class ReadScene(NamedTuple):
    """A scene, and what its ``Scene`` does not say.

    Attributes:
        scene: The scene.
        dataset: Where it comes from, as ``av2-sensor`` or ``nuscenes``.
        annotation_hz: Rate at which people or trackers placed the boxes; less than 10
            where steps between were interpolated.
    """

    scene: Scene
    dataset: str
    annotation_hz: float


@runtime_checkable
class SceneSource(Protocol):
    """A kind of scene files."""

    def find(self, folder: Path, names: Sequence[str]) -> list[SceneFiles]:
        """Find the scenes that a folder holds directly, by their content.

        Args:
            folder: The folder.
            names: Of the files in it, in order.
        """

    def label(self, files: SceneFiles) -> Label:
        """Tell split and id of a scene. Must not raise: damage is named by ``read``."""

    def read(self, files: SceneFiles, now: int | None) -> ReadScene:
        """Read one scene.

        Args:
            files: As ``find`` gave them.
            now: Last step of the history; None for the source's own.

        Raises:
            RecordError: naming why it is no scene that can be used.
            OSError: if a file cannot be read.
        """


def read_head(path: Path) -> bytes:
    """Read the first bytes of a file; none of what is no file or cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file of bounded size.

    Raises:
        RecordError: if it is empty or too long.
        OSError: if it cannot be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise RecordError(f"{path.name} is longer than the limit of {MAX_FILE_BYTES} bytes")
    if not data:
        raise RecordError(f"{path.name} is empty")
    return data


def short_name(path: Path) -> str:
    """Name a scene by its folder or file and the folder above."""
    return "/".join(path.parts[-2:]) if path.parent.name else path.name


NEAR_FOLDERS = 2
"""Folders above a scene whose names may tell its split."""


def split_in(words: Sequence[str]) -> str | None:
    """Find a split in the names of folders or of a data set; the last that names one."""
    for word in reversed(words):
        for part in reversed(re.split(r"[^A-Za-z]+", word)):
            if part.lower() in _SPLITS:
                return _SPLITS[part.lower()]
    return None
