"""The sources that keep scenes in files of their own, and where their scenes lie.

WOMD's TFRecords are streams of many scenes (``tfrecord``, ``womd``) and not among them.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from infgen.sources import argoverse2, scenarionet
from infgen.sources.remote_files import fetched
from infgen.sources.scene_files import (
    Label,
    ReadScene,
    SceneFiles,
    SceneSource,
    read_head,
)
from infgen.sources.tfrecord import is_record_header

SOURCES: dict[str, SceneSource] = {
    "argoverse2": argoverse2,
    "scenarionet": scenarionet,
}
"""By name, which is part of the names of units. A new source is one line here."""
RECORDS = ".tfrecord"
"""Part of the names of WOMD's files ... and of scenes that were converted from them."""


class FoundScene(NamedTuple):
    """A scene on disk or at a URL, not yet read.

    Attributes:
        source: Name of its source.
        files: Its files; those at URLs are copied here whenever it is read.
    """

    source: str
    files: SceneFiles

    @property
    def label(self) -> Label:
        """Split and id."""
        with fetched(self.files) as files:
            return SOURCES[self.source].label(files)

    def read(self, now: int | None = None) -> ReadScene:
        """Read it.

        Raises:
            RecordError: naming why it is no scene that can be used.
            OSError: if a file cannot be read.
        """
        with fetched(self.files) as files:
            return SOURCES[self.source].read(files, now)


def find_below(folder: str) -> Iterator[FoundScene]:
    """Find the scenes in a folder and all folders below, in order.

    What lies below a folder that is one scene, such as camera images, is not looked at.
    """
    seen: set[tuple[int, int]] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        stat = os.stat(place)
        found = (
            list(find_in(place, names)) if (stat.st_dev, stat.st_ino) not in seen else []
        )
        seen.add((stat.st_dev, stat.st_ino))
        yield from found
        is_scene = any(len(scene.files.paths) > 1 for scene in found)
        inner = (name for name in sorted(folders) if not name.startswith("."))
        folders[:] = () if is_scene else [n for n in inner if not _is_known(place, n, seen)]


def find_in(folder: str, names: list[str]) -> Iterator[FoundScene]:
    """Find the scenes that a folder holds directly, in order."""
    files = [
        name
        for name in sorted(names)
        if not name.startswith(".") and not is_tfrecord(Path(folder, name))
    ]
    for name, source in SOURCES.items():
        for each in source.find(Path(folder), files) if files else ():
            yield FoundScene(name, each)


def is_tfrecord(path: Path) -> bool:
    """Tell whether a file is named as a TFRecord, and is no pickle of a scene from one."""
    if RECORDS not in path.name:
        return False
    head = read_head(path)
    return not scenarionet.is_pickle(head) or is_record_header(head)


def is_scene_table(path: Path) -> bool:
    """Tell whether a file is a pickle: of no scene, where its source did not find it."""
    head = read_head(path)
    return scenarionet.is_pickle(head) and not is_record_header(head)


def _is_known(place: str, name: str, seen: set[tuple[int, int]]) -> bool:
    """Whether a folder was looked at already, by way of a link."""
    try:
        stat = os.stat(os.path.join(place, name))
    except OSError:
        return True
    return (stat.st_dev, stat.st_ino) in seen
